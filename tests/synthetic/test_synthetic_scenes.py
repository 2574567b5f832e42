"""Variants of the default person: lens, tint, gloss and test_scale change what they should."""

import json

import cv2
import numpy as np
import pytest
import tiny_characters

from gsgan.data.crop import distort, undistort
from gsgan.data.datamodule import GsganData
from gsgan.synthetic.scene_setup import (
    Scene,
    SceneSettings,
    Tint,
    dataset_key,
    make_tints,
)
from gsgan.synthetic.scenes import ensure_scene
from gsgan.utils.errors import ConfigError

LENS = (-0.28, 0.09, 0.001, -0.0008, -0.01)
# Three cameras: the tints of two would be each other's inverse, as their mean is none.
TINY = tiny_characters.TINY | {
    "size": 48,
    "train_cameras": 3,
    "rays_per_pixel": 2,
}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Makes a variant of the tiny person, once each, in one cache."""
    cache = tmp_path_factory.mktemp("cache")

    def run(**options):
        return ensure_scene(
            cache=cache, workers=1, progress=False, **TINY, **options
        )

    return run


@pytest.fixture(scope="module")
def stage():
    return Scene(SceneSettings(**TINY))


def images(root, kind, camera):
    paths = sorted((root / kind / camera).glob("*.png"))
    return np.stack(
        [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in paths]
    ).astype(float)


# ---------------------------------------------------------------- the default person


def test_options_without_effect_give_the_default_persons_folder():
    nothing = SceneSettings(
        **TINY, lens=[0.0] * 5, tint=0, gloss=0, test_scale=[]
    )
    assert nothing == SceneSettings(**TINY)
    assert dataset_key(nothing) == dataset_key(SceneSettings(**TINY))


def test_person_and_motion_of_a_variant_are_the_default_ones(scene):
    plain, tinted = scene(), scene(tint=0.1)
    for name in ("landmarks3d.npz", "hands3d.npz", "body_pose.npz"):
        assert (plain / name).read_bytes() == (tinted / name).read_bytes()
    assert (plain / "cameras.json").read_text() == (
        tinted / "cameras.json"
    ).read_text()


# ---------------------------------------------------------------- lenses


def test_undistort_inverts_distort():
    x = np.random.default_rng(0).uniform(-0.6, 0.6, (200, 2))
    dist = np.array(LENS)
    np.testing.assert_allclose(distort(undistort(x, dist), dist), x, atol=1e-10)
    np.testing.assert_allclose(undistort(distort(x, dist), dist), x, atol=1e-9)
    np.testing.assert_array_equal(undistort(x, np.zeros(5)), x)
    assert undistort(np.zeros((0, 2)), dist).shape == (0, 2)
    fold = np.array([-0.5, 0, 0, 0, 0])  # at r = 0.816, shown at 0.544
    found = undistort(np.array([[0.5, 0.0], [0.56, 0.0], [0.0, 3.0]]), fold)
    assert np.isnan(found).any(axis=1).tolist() == [False, True, True]


def test_the_ray_of_a_points_pixel_hits_the_point(stage):
    views = Scene(SceneSettings(**TINY, lens=LENS)).views
    points = stage.mesh(0)[0][::700]
    for view in views.values():
        pixel = np.concatenate(
            [view.project(points), np.ones((len(points), 1))], axis=1
        )
        pinhole = pixel @ np.linalg.inv(view.K).T @ view.R
        rays = view.bend(
            pinhole / np.linalg.norm(pinhole, axis=1, keepdims=True)
        )
        off = np.linalg.norm(np.cross(points - view.centre, rays), axis=1)
        assert off.max() < 1e-8


def test_the_reader_finds_the_lens(scene):
    assert not GsganData(root=str(scene())).info.has_distortion
    bent = GsganData(root=str(scene(lens=LENS)))
    assert bent.info.has_distortion
    assert bent.layout.cameras["cam03"].dist.tolist() == [*LENS, 0, 0, 0]


@pytest.mark.parametrize("lens", [(-2.0, 0, 0, 0, 0), (0, 0, 0, 0, -9.0)])
def test_a_lens_that_folds_back_is_refused(lens):
    with pytest.raises(ConfigError, match="folds back"):
        Scene(SceneSettings(**TINY, lens=lens))


# ---------------------------------------------------------------- tints


def test_tints_differ_between_cameras_and_average_to_none():
    tints = make_tints(0.08, 6, seed=0)
    A, b = np.stack([t.A for t in tints]), np.stack([t.b for t in tints])
    np.testing.assert_allclose(A.mean(axis=0), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(b.mean(axis=0), 0, atol=1e-12)
    # grey is changed by the gains alone, which are within the requested range
    assert np.abs(A.sum(axis=2) - 1).max() <= 0.08 + 1e-12
    gaps = [np.abs(A[i] - A[j]).max() for i in range(6) for j in range(i)]
    assert min(gaps) > 0.01
    again, other = make_tints(0.08, 6, seed=0), make_tints(0.08, 6, seed=1)
    assert all(
        np.array_equal(s.A, t.A) for s, t in zip(tints, again, strict=True)
    )
    assert not np.array_equal(tints[0].A, other[0].A)


def test_a_tint_leaves_the_background_black_and_edges_premultiplied():
    tint = Tint(1.1 * np.eye(3), np.full(3, 0.05))
    alpha = np.array([[0.0, 0.5, 1.0]])
    image = np.array([0.4, 0.5, 0.6]) * alpha[..., None]
    out = tint(image, alpha)
    np.testing.assert_allclose(out[0, 2], [0.49, 0.60, 0.71])
    np.testing.assert_allclose(out[0, 1], out[0, 2] / 2)
    assert out[0, 0].max() == 0


def test_each_training_camera_keeps_its_tint_over_all_frames(scene):
    plain, tinted = scene(), scene(tint=0.1)
    expected = make_tints(0.1, 3, TINY.get("seed", 0))
    for camera, tint in zip(("cam00", "cam01", "cam02"), expected, strict=True):
        masks = images(plain, "masks", camera)
        assert images(tinted, "images", camera)[masks == 0].max() == 0
        for before, after, mask in zip(
            images(plain, "images", camera), images(tinted, "images", camera), masks,
            strict=True,
        ):  # fmt: skip
            sure = (
                (mask == 255)
                & (after.max(axis=-1) < 255)
                & (after.min(axis=-1) > 0)
            )
            rgb = np.concatenate(
                [before[sure][:, ::-1] / 255, np.ones((sure.sum(), 1))], axis=1
            )
            found = np.linalg.lstsq(
                rgb, after[sure][:, ::-1] / 255, rcond=None
            )[0].T
            np.testing.assert_allclose(found[:, :3], tint.A, atol=0.03)
            np.testing.assert_allclose(found[:, 3], tint.b, atol=0.01)


def test_held_out_cameras_are_neutral_and_no_file_contains_the_tints(scene):
    plain, tinted = scene(), scene(tint=0.1)
    assert np.array_equal(
        *(images(r, "images", "cam03") for r in (plain, tinted))
    )
    gain = repr(float(make_tints(0.1, 3, 0)[0].A[0, 0]))[:8]
    for path in tinted.rglob("*.json"):
        assert gain not in path.read_text()


# ---------------------------------------------------------------- scale


@pytest.mark.slow
def test_scaled_test_cameras_see_the_person_at_their_scale(scene, stage):
    root = scene(test_scale=[0.5, 2])
    splits = json.loads((root / "meta.json").read_text())["splits"]
    assert splits["train_cameras"] == ["cam00", "cam01", "cam02"]
    assert splits["test_cameras"] == ["cam03", "cam03_x0.5", "cam03_x2"]
    data = GsganData(root=str(root))
    layout, p = data.layout, stage.mesh(0)[0][::500]
    middle = np.array([24.0, 24.0])
    views = Scene(SceneSettings(**TINY, test_scale=(0.5, 2.0))).views
    for scale in (0.5, 2.0):
        twin = f"cam03_x{scale:g}"
        assert (
            layout.cameras[twin].K[0, 0]
            == scale * layout.cameras["cam03"].K[0, 0]
        )
        expected = scale * (views["cam03"].project(p) - middle) + middle
        np.testing.assert_allclose(views[twin].project(p), expected)
    area = {c: images(root, "masks", c).sum() for c in splits["test_cameras"]}
    assert area["cam03_x0.5"] == pytest.approx(area["cam03"] / 4, rel=0.05)
    small = images(root, "images", "cam03_x0.5")[0]
    shrunk = cv2.resize(
        images(root, "images", "cam03")[0],
        (24, 24),
        interpolation=cv2.INTER_AREA,
    )
    assert np.abs(small[12:36, 12:36] - shrunk).mean() < 6
    for camera in ("cam00", "cam03"):
        assert np.array_equal(
            *(images(r, "images", camera) for r in (scene(), root))
        )
