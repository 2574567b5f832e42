"""The tracer and the appearance of the synthetic person."""

from __future__ import annotations

import numpy as np
from gsgan.data.synthetic.identity import SHIRT_PATTERNS, Marks, albedo, make_identity

from gsgan.body.free import free_body
from gsgan.data.synthetic.scene_setup import Scene, Settings
from gsgan.data.synthetic.trace import (
    Light,
    Person,
    PosedPerson,
    Tracer,
    View,
    majority,
    pixel_offsets,
    pixel_rays,
)

TINY = {
    "size": 32,
    "train_cameras": 1,
    "test_cameras": 1,
    "frames": 3,
    "test_frames": 1,
    "rays_per_pixel": 1,
}


def square(z, half):
    """Two triangles facing up at a height."""
    v = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return v, np.array([[0, 1, 2], [0, 2, 3]])


def from_above(size=20, height=3.0, focal=20.0):
    """A camera that looks straight down."""
    R = np.diag([1.0, -1.0, -1.0])
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    return View(K, R, np.array([0, 0, height]), (size, size))


def flat_person(*squares):
    v = np.concatenate([s[0] for s in squares])
    f = np.concatenate([s[1] + 4 * i for i, s in enumerate(squares)])
    marks = Marks(free_body().landmarks.double().numpy())
    labels = np.repeat(np.arange(1, len(squares) + 1), 2)
    nothing = np.zeros((0, 3))
    return Person(v, f, labels, np.full(len(f), 2), nothing, nothing, make_identity(0), marks)


def test_square_covers_exactly_its_pixels():
    person = flat_person(square(1.0, 0.5))  # 2 m below the camera: 20 px / m / 2 m, 10 pixels wide
    moment = PosedPerson(person, person.vertices, np.zeros(0), Light(direction=(0, 0, 1)))
    _, alpha, labels = moment.render(from_above(), 4)
    expected = np.zeros((20, 20))
    expected[5:15, 5:15] = 1
    assert np.array_equal(alpha, expected)
    assert np.array_equal(labels, expected)


def test_shading_matches_the_formula():
    person = flat_person(square(1.0, 0.5))
    light = Light(direction=(0.0, 3.0, 4.0), sun=0.5, sky=0.3, ground=0.1)
    image, _, _ = PosedPerson(person, person.vertices, np.zeros(0), light).render(from_above(), 1)
    point = np.array([[0.45, 0.45, 1.0]])
    paint = albedo(person.identity, person.marks, point, np.array([2])) ** 2.2
    np.testing.assert_allclose(image[5, 14], (paint[0] * (0.5 * 0.8 + 0.3)) ** (1 / 2.2), rtol=1e-6)


def test_shadow_falls_away_from_the_sun():
    person = flat_person(square(0.0, 1.0), square(0.5, 0.1))
    light = Light(direction=(1.0, 0.0, 1.0), sun=0.5, sky=0.3, ground=0.3)
    view = from_above(size=60, focal=60.0)
    image, _, labels = PosedPerson(person, person.vertices, np.zeros(0), light).render(view, 1)
    assert set(np.unique(labels)) == {0, 1, 2}

    def at(x, y):
        u, v = np.floor(view.project(np.array([[x, y, 0.0]]))[0]).astype(int)
        return image[v, u]

    assert np.all(at(-0.5, 0) < at(-0.8, 0))  # 0.5 m high, light from +x at 45°: 0.5 m to -x
    np.testing.assert_allclose(at(-0.8, 0), at(0.6, 0.5))


def first_hits(triangles, origins, directions):
    """Every ray against every triangle (Möller and Trumbore): face and (u, v) of the nearest."""
    corner, edges = triangles[:, 0], triangles[:, 1:] - triangles[:, :1]
    p = np.cross(directions[:, None], edges[None, :, 1])
    determinant = (p * edges[:, 0]).sum(-1)
    offset = origins[:, None] - corner
    q = np.cross(offset, edges[None, :, 0])
    u, v = (offset * p).sum(-1) / determinant, (q * directions[:, None]).sum(-1) / determinant
    distance = (q * edges[:, 1]).sum(-1) / determinant
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    distance = np.where(hit, distance, np.inf)
    nearest, rows = distance.argmin(axis=1), np.arange(len(origins))
    face = np.where(hit.any(axis=1), nearest, -1)
    return face, np.stack([u[rows, nearest], v[rows, nearest]], axis=1)


def test_the_tracer_finds_the_first_triangle():
    rng = np.random.default_rng(0)
    triangles = rng.normal(size=(40, 3, 3))
    origins = rng.normal(size=(200, 3)) * 4
    directions = -origins + rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    face, uv = Tracer(triangles).first(origins, directions)
    expected, expected_uv = first_hits(triangles, origins, directions)
    assert (face >= 0).sum() > 50
    assert np.array_equal(face, expected)
    np.testing.assert_allclose(uv[face >= 0], expected_uv[face >= 0], atol=1e-4)


def test_bending_changes_the_cloth_and_only_the_cloth():
    scene = Scene(Settings(**{**TINY, "size": 48}))
    view, vertices = scene.views["cam00"], scene.vertices(0)
    still = PosedPerson(scene.person, vertices, np.zeros(7), Light()).render(view, 1)
    bent = PosedPerson(scene.person, vertices, np.full(7, 1.5), Light()).render(view, 1)
    changed = np.abs(still[0] - bent[0]).max(axis=-1) > 1e-6
    cloth = (still[2] == 3) | (still[2] == 4)
    assert changed[cloth].mean() > 0.3
    assert not changed[~cloth].any()


def test_rays_pass_through_pixel_centres_first():
    offsets = pixel_offsets(5)
    assert offsets[0].tolist() == [0.5, 0.5]
    assert len(np.unique(offsets, axis=0)) == 5
    view = from_above()
    origin, directions = pixel_rays(view, (3, 4, 4, 5), 1)
    pixel = view.project(origin + directions)
    np.testing.assert_allclose(pixel, [[3.5, 4.5]])


def test_majority_of_rays():
    part = np.array([[[0, 0, 2, 2], [0, 0, 0, 2], [1, 2, 2, 0], [2, 1, 1, 2]]])
    assert majority(part, 3).tolist() == [[2, 0, 2, 1]]


def test_identities_differ_and_cover_the_patterns():
    people = [make_identity(i) for i in range(30)]
    assert len(set(people)) == 30
    assert {p.shirt_pattern for p in people} == set(SHIRT_PATTERNS)
    assert make_identity(4) == make_identity(4)


def test_albedo_is_a_colour_everywhere():
    body = free_body()
    points = body.vertices[body.faces].mean(1).double().numpy()
    surface = body.face_surface.numpy()
    marks = Marks(body.landmarks.double().numpy())
    for seed in range(6):
        colour = albedo(make_identity(seed), marks, points, surface)
        assert colour.min() >= 0
        assert colour.max() <= 1
        assert colour[surface == 3].std() > 0.1  # the shirt has a pattern
