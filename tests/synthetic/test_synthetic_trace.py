"""The tracer of characters: geometry, light, textures, masks and labels."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from tiny_characters import character, from_above, from_front, plain, square

from gsgan.motion.character import Surface
from gsgan.synthetic import trace
from gsgan.synthetic.camera import SceneCamera, pixel_offsets, pixel_rays
from gsgan.synthetic.textures import Textures, linear
from gsgan.synthetic.trace import (
    Appearance,
    Light,
    PosedCharacter,
    Wrinkles,
    encode,
)

GREY = 0.21586  # linear light of sRGB 128
MATT = Light(direction=(0, 3, 4), sun=(0.4, 0.3, 0.2), sky=(0.3,) * 3, ground=(0.1,) * 3,
             spread=0.0, shine=0.0)  # fmt: skip


def posed(c, light=MATT, wrinkles=None):
    return PosedCharacter(Appearance(c), c.vertices, c.normals, light, wrinkles)


def at(view, image, point):
    u, v = np.floor(view.project(np.array([point], float))[0]).astype(int)
    return image[v, u]


def lumpy(seed=0):
    """A closed, lumpy body with thin limbs, in three parts."""
    rng = np.random.default_rng(seed)
    parts = []
    for scale, middle in (((0.3, 0.2, 0.5), (0, 0, 0)), ((0.6, 0.03, 0.03), (0.4, 0, 0.2)),
                          ((0.02, 0.02, 0.5), (-0.2, 0.1, -0.6))):  # fmt: skip
        ball = trimesh.creation.icosphere(subdivisions=2)
        v = ball.vertices * (
            1 + 0.15 * rng.normal(size=(len(ball.vertices), 1))
        )
        v = v * scale + middle
        parts.append((v, ball.faces, rng.random((len(v), 2))))
    return character(parts, labels=[1, 2, 3])


def test_square_covers_exactly_its_pixels():
    # 2 m below the camera: 20 px / m / 2 m, 10 pixels wide
    _, alpha, labels = posed(character([square(1.0, 0.5)])).render(
        from_above(), 4
    )
    expected = np.zeros((20, 20))
    expected[5:15, 5:15] = 1
    assert np.array_equal(alpha, expected)
    assert np.array_equal(labels, expected)


def test_shading_matches_the_formula():
    image, _, _ = posed(character([square(1.0, 0.5)])).render(from_above(), 1)
    expected = encode(GREY * (0.8 * np.array(MATT.sun) + 0.3))
    np.testing.assert_allclose(image[5, 14], expected, rtol=2e-4)


def test_the_back_of_cloth_is_lit_on_its_own_side():
    below = SceneCamera(
        from_above().K, np.eye(3), np.array([0, 0, 1.0]), (20, 20)
    )
    image, alpha, _ = posed(character([square(1.0, 0.5)])).render(below, 1)
    assert alpha[10, 10] == 1
    np.testing.assert_allclose(
        image[10, 10], encode(np.full(3, GREY * 0.1)), rtol=2e-4
    )


def test_shadow_falls_away_from_the_sun():
    c = character([square(0.0, 1.0), square(0.5, 0.1)], labels=[1, 2])
    light = replace(MATT, direction=(1.0, 0.0, 1.0))
    view = from_above(size=60, focal=60.0)
    image, _, labels = posed(c, light).render(view, 1)
    assert set(np.unique(labels)) == {0, 1, 2}
    shaded, lit = at(view, image, (-0.5, 0, 0)), at(view, image, (-0.8, 0, 0))
    assert np.all(
        shaded < 0.85 * lit
    )  # 0.5 m high, light from +x at 45°: 0.5 m to -x
    np.testing.assert_allclose(lit, at(view, image, (0.7, 0.6, 0)), rtol=0.02)
    soft, _, _ = posed(c, replace(light, spread=0.2)).render(view, 64)
    edge = at(view, soft, (-0.5, 0.1, 0))
    assert np.all((edge > 1.02 * shaded) & (edge < 0.98 * lit))


def test_the_sky_is_darker_under_cover():
    c = character([square(0.0, 1.0), square(0.3, 0.5)])
    sky = PosedCharacter(Appearance(c), c.vertices, c.normals, MATT).attributes[
        :, 6:8
    ]
    np.testing.assert_allclose(
        sky[4:, 0], 1
    )  # nothing is above the upper square
    assert np.all(sky[4:, 1] < 0.9)


def test_a_coarse_sphere_has_no_facets_in_its_shadow():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    c = character(
        [(ball.vertices, ball.faces, np.zeros((len(ball.vertices), 2)))]
    )
    dark = replace(
        MATT, direction=(1, 0, 0), sun=(1, 1, 1), sky=(0,) * 3, ground=(0,) * 3
    )
    view = from_front()
    image, _, _ = posed(c, dark).render(view, 1)
    # from the terminator, the middle of the disc, to the sun
    for angle in (0.15, 0.3, 0.6, 0.9):
        point = 0.5 * np.array([np.sin(angle), -np.cos(angle), 0])
        expected = encode(GREY * np.array([np.sin(angle)]))
        np.testing.assert_allclose(
            at(view, image, point)[0], expected, atol=0.05
        )


def test_texture_is_upright():
    colours = np.zeros((64, 64, 4), np.uint8)
    colours[:32, :32], colours[:32, 32:] = (255, 0, 0, 255), (0, 255, 0, 255)
    colours[32:, :32], colours[32:, 32:] = (
        (0, 0, 255, 255),
        (255, 255, 255, 255),
    )
    c = character([square(1.0, 0.5)], [Surface("four", colours)])
    image, _, _ = posed(c).render(from_above(), 1)
    # top left is red: v runs down, +y is up in the image
    assert image[7, 7].argmax() == 0
    assert image[7, 12].argmax() == 1
    assert image[12, 7].argmax() == 2
    assert image[12, 12].min() > 0.3


def test_colours_of_vertices_multiply_light_and_coverage():
    """Half the light at the left, all at the right; cut out where coverage is below one half."""
    view = from_above()
    c = character([square(1.0, 0.5)], [plain(cutoff=0.5)])
    image, _, _ = posed(c).render(view, 4)
    tint = np.array(
        [[0.5, 1, 0, 1], [1, 1, 0, 0], [1, 1, 0, 0], [0.5, 1, 0, 1]]
    )
    tinted, alpha, _ = posed(replace(c, tint=tint)).render(view, 4)
    for x in (-0.4, -0.2):
        share = 0.5 + 0.5 * (x + 0.5)
        light = linear(at(view, image, (x, 0, 1.0)))
        expected = light * [share, 1, 0]
        found = linear(at(view, tinted, (x, 0, 1.0)))
        np.testing.assert_allclose(found, expected, atol=0.01)
    assert at(view, alpha, (-0.2, 0, 1.0)) == 1
    assert at(view, alpha, (0.2, 0, 1.0)) == 0


def test_fine_texture_is_averaged_as_light():
    checks = np.indices((512, 512)).sum(axis=0) % 2 * 255
    colours = np.dstack([checks] * 3 + [np.full((512, 512), 255)]).astype(
        np.uint8
    )
    c = character([square(1.0, 0.5)], [Surface("checks", colours)])
    image, _, _ = posed(c).render(from_above(), 1)
    expected = encode(0.5 * (0.8 * np.array(MATT.sun) + 0.3))
    np.testing.assert_allclose(
        image[6:14, 6:14], np.tile(expected, (8, 8, 1)), rtol=0.01
    )


def test_textures_are_bilinear_and_repeat():
    colours = np.zeros((1, 2, 4), np.uint8)
    colours[0, 1] = 255
    textures = Textures((Surface("two", colours), plain()))
    uv = np.array(
        [[0.25, 0.5], [0.75, 0.3], [0.5, 0.5], [1.25, 7.0], [-0.25, 0.5]],
        np.float32,
    )
    zero = np.zeros(5, int)
    rgb, coverage, normal = textures(zero, uv, zero)
    np.testing.assert_allclose(rgb[:, 0], [0, 1, 0.5, 0, 1], atol=1e-6)
    np.testing.assert_allclose(coverage, rgb[:, 0])
    np.testing.assert_allclose(normal, np.tile([0, 0, 1], (5, 1)))
    # past the last level
    rgb, _, _ = textures(np.array([0, 1]), uv[:2], np.array([9, 9]))
    np.testing.assert_allclose(rgb[:, 0], [0.5, GREY], rtol=1e-3)


def test_rays_and_sun_pass_through_cut_outs():
    colours = np.full((64, 64, 4), 255, np.uint8)
    colours[16:48, 16:48, 3] = 0
    holey, dark = Surface("holey", colours, cutoff=0.5), plain((40, 40, 40))
    c = character([square(0.5, 0.5), square(0.0, 1.0)], [holey, dark], [1, 2])
    light = replace(MATT, direction=(2, 0, 5))
    view = from_above(size=60, focal=60.0)
    image, alpha, labels = posed(c, light).render(view, 4)
    assert labels[30, 30] == 2
    assert at(view, labels, (0.4, 0, 0.5)) == 1
    assert alpha[30, 30] == 1
    hole, shaded = at(view, image, (-0.1, 0, 0)), at(view, image, (-0.66, 0, 0))
    assert np.all(
        hole > 1.2 * shaded
    )  # the sun shines through the hole, 0.2 m to -x
    opaque = character(
        [square(0.5, 0.5), square(0.0, 1.0)], [replace(holey, cutoff=0), dark]
    )
    assert posed(opaque).render(view, 1)[2][30, 30] == 1


def test_normal_map_tilts_towards_its_axes():
    tilted = np.array(
        [[[128 + 76, 128, 128 + 102]]], np.uint8
    )  # 0.6 along +u, 0.8 up
    c = character([square(1.0, 0.5)], [plain(normal=tilted)])
    bright = [
        posed(c, replace(MATT, direction=d)).render(from_above(), 1)[0][
            10, 10, 0
        ]
        for d in ((0.6, 0, 0.8), (-0.6, 0, 0.8), (0, 0.6, 0.8))
    ]
    assert bright[0] > bright[2] > bright[1]
    # +y of the map is up in the texture
    up = np.array([[[128, 128 + 76, 128 + 102]]], np.uint8)
    c = character([square(1.0, 0.5)], [plain(normal=up)])
    bright = [
        posed(c, replace(MATT, direction=(0, y, 0.8))).render(from_above(), 1)[
            0
        ][10, 10, 0]
        for y in (0.6, -0.6)
    ]
    assert bright[0] > bright[1]


def test_wrinkles_tilt_normals():
    c = character([square(1.0, 0.5)])
    phase = (20 * c.vertices[:, 0]).astype(np.float32)
    across = np.tile(np.float32([1, 0, 0]), (4, 1))
    light = replace(MATT, direction=(1, 0, 1))
    smooth, _, _ = posed(c, light, Wrinkles(phase, 0 * phase, across)).render(
        from_above(), 1
    )
    assert np.array_equal(smooth, posed(c, light).render(from_above(), 1)[0])
    folded, _, _ = posed(
        c, light, Wrinkles(phase, 0 * phase + 0.5, across)
    ).render(from_above(), 1)
    assert np.ptp(folded[10, 5:15, 0]) > 0.05
    np.testing.assert_allclose(folded[6, 5:15], folded[13, 5:15], atol=1e-5)


def test_gloss_is_of_clothes_only():
    light = replace(MATT, direction=(0, 0, 1), gloss=0.5)
    for label, shines in ((2, True), (3, False)):
        c = character([square(1.0, 0.5)], labels=[label])
        dull, glossy = (
            posed(c, x).render(from_above(), 1)[0] for x in (MATT, light)
        )
        matt = posed(c, replace(light, gloss=0)).render(from_above(), 1)[0]
        assert np.array_equal(matt, glossy) != shines
        assert dull.max() < glossy.max()


def test_no_light_is_clipped():
    light = np.linspace(0, 4, 400)
    shown = encode(light)
    assert np.all(np.diff(shown) > 0)
    assert shown[-1] < 1
    exact = light[light < 0.5]
    np.testing.assert_allclose(
        linear(encode(exact).astype(np.float32)), exact, atol=1e-5
    )


def z_buffer(c, view, fine):
    """Label ``[H*fine, W*fine]`` of the nearest face at the centre of each finer pixel."""
    H, W = view.size[0] * fine, view.size[1] * fine
    pixel = view.project(c.vertices) * fine - 0.5
    depth = c.vertices @ view.R[2] + view.t[2]
    nearest, labels = np.full((H, W), np.inf), np.zeros((H, W), int)
    for face, label in zip(c.faces, c.labels, strict=True):
        p, inverse = pixel[face], 1 / depth[face]
        low = np.maximum(np.ceil(p.min(axis=0)), 0).astype(int)
        high = np.minimum(np.floor(p.max(axis=0)), [W - 1, H - 1]).astype(int)
        T = np.stack([p[0] - p[2], p[1] - p[2]], axis=1)
        if (high < low).any() or abs(np.linalg.det(T)) < 1e-12:
            continue
        y, x = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
        w = np.stack([x - p[2, 0], y - p[2, 1]], axis=-1) @ np.linalg.inv(T).T
        w = np.concatenate([w, 1 - w.sum(axis=-1, keepdims=True)], axis=-1)
        z = 1 / np.maximum(w @ inverse, 1e-9)
        here = (w >= 0).all(axis=-1) & (z < nearest[y, x])
        nearest[y[here], x[here]], labels[y[here], x[here]] = z[here], label
    return labels


@pytest.mark.parametrize(
    "view", [from_front(128, 3.0, 160.0), from_front(160, 2.5, 180.0, 0.4)]
)
def test_masks_and_labels_agree_with_a_z_buffer(view):
    c, fine = lumpy(), 6
    _, centre, at_centre = posed(c).render(view, 1)
    expected = z_buffer(c, view, 1)  # with the same samples: the same picture
    assert ((centre > 0) & (expected > 0)).sum() >= 0.999 * (
        (centre > 0) | (expected > 0)
    ).sum()
    assert (at_centre == expected).mean() >= 0.9995
    _, alpha, labels = posed(c).render(view, 16)
    expected = z_buffer(c, view, fine)
    H, W = view.size
    blocks = expected.reshape(H, fine, W, fine).swapaxes(1, 2).reshape(H, W, -1)
    coverage = (blocks > 0).mean(axis=-1)
    mask, other = alpha > 0.5, coverage > 0.5
    assert mask.sum() > 1500
    assert (mask & other).sum() >= 0.995 * (mask | other).sum()
    assert (
        np.minimum(alpha, coverage).sum()
        >= 0.99 * np.maximum(alpha, coverage).sum()
    )
    assert (labels[mask] > 0).mean() >= 0.995
    pure = (blocks == blocks[..., :1]).all(axis=-1)
    assert np.array_equal(labels[pure], blocks[pure][:, 0])


@pytest.mark.parametrize(
    ("where", "name", "value"),
    [
        (
            PosedCharacter,
            "_find_touched",
            lambda self, v: np.ones(v.size, bool),
        ),
        (trace, "BLOCK_RAYS", 100),
    ],
)
def test_every_touched_pixel_is_found_and_the_same_in_any_blocks(
    monkeypatch, where, name, value
):
    view = from_front(48, 3.0, 40.0)
    found = posed(lumpy(3)).render(view, 9)
    monkeypatch.setattr(where, name, value)
    for a, b in zip(found, posed(lumpy(3)).render(view, 9), strict=True):
        assert np.array_equal(a, b)


def test_a_person_partly_outside_is_cropped():
    moment, view = posed(lumpy()), from_front(64, 3.0, 100.0)
    K = view.K.copy()
    K[:2, 2] -= [30, 12]
    image, alpha, labels = moment.render(view, 4)
    for whole, part in zip((image, alpha, labels), moment.render(
        replace(view, K=K, size=(40, 34)), 4), strict=True):  # fmt: skip
        np.testing.assert_allclose(part, whole[12:52, 30:64], atol=1e-5)


def test_a_camera_that_sees_nothing():
    moment, view = posed(lumpy()), from_front(16)
    aside = view.K.copy()
    aside[0, 2] = 900
    away = replace(
        view, R=np.diag([-1, 1, -1]) @ view.R, t=np.diag([-1, 1, -1]) @ view.t
    )
    for v in (away, replace(view, K=aside)):
        for out in moment.render(v, 4):
            assert not out.any()


@pytest.mark.parametrize("rays", [1, 4, 9, 16])
def test_rays_are_spread_about_pixel_centres(rays):
    offsets = pixel_offsets(rays)
    assert len(np.unique(offsets, axis=0)) == rays
    assert offsets.min() >= 0
    assert offsets.max() < 1
    np.testing.assert_allclose(
        np.sort(offsets[:, 0]), (np.arange(rays) + 0.5) / rays
    )
    np.testing.assert_allclose(
        offsets.mean(axis=0), 0.5, atol=0.13 if rays > 1 else 0
    )
    view = from_above()
    origin, directions = pixel_rays(view, np.array([3]), np.array([4]), rays)
    pixel = view.project(origin + directions)
    np.testing.assert_allclose(pixel - [3, 4], offsets, atol=1e-9)
