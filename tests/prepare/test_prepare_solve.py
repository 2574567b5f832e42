"""Triangulation, flips, refinement, smoothing on motions with known ground truth."""

import numpy as np
import pytest
from capture_scenes import (
    ANGLES,
    LENS,
    no_outlines,
    outlines,
    ring,
    seen,
    turned,
)
from configs import solve_settings
from make import distorted_pixels, skeletons

from gsgan.prepare import triangulate
from gsgan.prepare.camera_array import (
    CameraArray,
    camera_moves,
    refine_cameras,
    undistort_points,
)
from gsgan.prepare.cleanse import cleanse, smooth
from gsgan.prepare.sides import apply_flips, find_flips
from gsgan.prepare.solve import (
    correct,
    median,
    refine,
    solve,
)
from gsgan.prepare.triangulate import plain, robust
from gsgan.skeleton.joints import FLIP_GROUPS as GROUPS
from gsgan.utils.errors import ConfigError

PRIORS = 2.0, 0.05  # degrees, metres


def flat(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1, *values.shape[3:])


def test_undistortion_inverts_the_lens():
    camera = ring(dist=LENS)[1]
    rig, p = CameraArray.of([camera]), skeletons(1)[0]
    stored = np.r_[distorted_pixels(vars(camera), p), [[np.nan, 3.0]]]
    straight = undistort_points(camera, stored)
    np.testing.assert_allclose(straight[:-1], rig.project(p)[0][0], atol=1e-4)
    assert (
        np.abs(straight[:-1] - stored[:-1]).max() > 1
    )  # the lens does something
    assert np.isnan(straight[-1]).all()


def test_exact_detections_give_exact_points():
    rig, p, uv, conf = seen(ring())
    truth = p.reshape(-1, 3)
    np.testing.assert_allclose(
        plain(rig, flat(uv), flat(conf)), truth, atol=1e-9
    )
    points = robust(rig, flat(uv), flat(conf))
    np.testing.assert_allclose(points.p, truth, atol=1e-9)
    assert points.error.max() < 1e-6


def test_one_outlier_is_rejected():
    rig, p, uv, conf = seen(ring(), noise=1.0)
    uv[2, :, 15] += [300, -200]  # one camera detects the left wrist elsewhere
    found = (
        plain(rig, flat(uv), flat(conf)),
        robust(rig, flat(uv), flat(conf)).p,
    )
    off = [
        np.linalg.norm(one.reshape(p.shape) - p, axis=-1)[:, 15].max()
        for one in found
    ]
    assert off[0] > 0.1
    assert off[1] < 0.01


def test_points_on_nearly_parallel_rays_are_missing(monkeypatch):
    rig, _, uv, conf = seen(ring(angles=(0.0, 0.003)))
    assert np.isnan(robust(rig, flat(uv), flat(conf)).p).all()
    monkeypatch.setattr(triangulate, "MAX_ELONGATION", 1e4)
    assert np.isfinite(robust(rig, flat(uv), flat(conf)).p).all()


def planted(shape: tuple[int, int, int]) -> np.ndarray:
    flips = np.zeros(shape, bool)
    flips[1, :5] = True  # one camera, everything, at the start
    flips[2, 7:9, 2] = True  # the legs of another
    flips[:3, 10, 1] = True  # three of four cameras swap the arms for one frame
    return flips


def test_planted_flips_are_found_and_corrected():
    rig, p, uv, conf = seen(ring(), noise=1.0)
    flips = planted((4, 12, 3))
    swapped = apply_flips(uv, flips, GROUPS)
    assert np.abs(swapped - uv).max() > 50
    found = find_flips(rig, swapped, conf, np.arange(conf.shape[1]) / 30)
    # Small pairs (the eyes) seen edge-on cannot be determined, and need not.
    np.testing.assert_array_equal(found[..., 1:], flips[..., 1:])
    corrected = apply_flips(swapped, found, GROUPS)
    np.testing.assert_allclose(corrected[:, :, 11:], uv[:, :, 11:])
    assert p.shape[0] == 12


def test_a_swap_in_all_cameras_is_found_from_the_motion():
    rig, _, uv, conf = seen(ring(), frames=20)
    flips = np.zeros((4, 20, 3), bool)
    flips[:, 8:11] = True
    swapped = apply_flips(uv, flips, GROUPS)
    found = find_flips(rig, swapped, conf, np.arange(conf.shape[1]) / 30)
    np.testing.assert_array_equal(found, flips)


def test_refinement_recovers_a_camera_that_was_bumped():
    rig, p, uv, conf = seen(ring(), frames=20, noise=0.3)
    given = turned(rig, 2, degrees=1.5, metres=0.03)
    start = robust(given, flat(uv), flat(conf))
    assert np.median(start.error[2]) > 20
    found = refine_cameras(given, given, start.p, flat(uv), flat(conf), *PRIORS)
    after = robust(found, flat(uv), flat(conf))
    assert np.median(after.error) < 0.5
    # The world may move a little as a whole, the cameras not against each other.
    angles, _ = camera_moves(relative(rig), relative(found))
    assert angles.max() < 0.1
    distances = np.linalg.norm(after.p[11] - after.p[24]) / np.linalg.norm(
        p[0, 11] - p[0, 24]
    )
    assert distances == pytest.approx(1, abs=0.02)


def relative(rig: CameraArray) -> CameraArray:
    """All cameras as seen from the first."""
    R = rig.R @ rig.R[0].T
    return CameraArray(rig.K, R, rig.t - np.einsum("cij,j->ci", R, rig.t[0]))


def test_refinement_of_two_cameras_and_of_nothing_stays_finite():
    rig, p, uv, conf = seen(ring(angles=(0.0, 1.3)), noise=1.0)
    found = refine_cameras(
        rig, rig, p.reshape(-1, 3), flat(uv), flat(conf), *PRIORS
    )
    assert np.isfinite(found.R).all()
    np.testing.assert_allclose(np.linalg.det(found.R), 1)
    nothing = refine_cameras(
        rig,
        rig,
        np.full((5, 3), np.nan),
        flat(uv)[:, :5],
        np.zeros((2, 5)),
        *PRIORS,
    )
    np.testing.assert_allclose(nothing.R, rig.R)


def test_smoothing_keeps_a_parabola_and_its_gaps():
    time = np.arange(40) / 60
    p = np.stack([time, 3 * time**2, 1 - time], axis=-1)[:, None].repeat(
        2, axis=1
    )
    p[10:14, 0] = np.nan
    weight = np.ones(p.shape[:2])
    weight[20, 1] = 0
    found = smooth(p, weight, time, seconds=0.05)
    assert np.isnan(found[10:14, 0]).all()
    assert np.isnan(found[20, 1]).all()
    known = np.isfinite(found)
    np.testing.assert_allclose(found[known], p[known], atol=1e-9)
    assert known.sum() == p.size - 3 * 5


def test_smoothing_halves_noise_and_respects_weights():
    rng = np.random.default_rng(0)
    time = np.arange(200) / 60
    truth = np.zeros((200, 1, 3))
    noisy = truth + 0.01 * rng.standard_normal(truth.shape)
    noisy[100] += 5.0
    weight = np.ones((200, 1))
    weight[100] = 1e-9
    found = smooth(noisy, weight, time, seconds=0.05)
    assert np.abs(found - truth).max() < 0.02
    assert found[:90].std() < 0.6 * noisy[:90].std()


def test_cleansing_removes_impossible_joints():
    p = skeletons(1).repeat(10, axis=0)
    p[3, 15] += [5, 0, 0]  # a wrist five metres away
    p[6, 27] += [0, 0, 0.3]  # a shin a good deal too short
    p[:, 31] = np.nan
    found, removed = cleanse(p)
    assert np.isnan(found[3, 15]).all()
    assert np.isnan(found[6, 27]).all()
    assert removed == {"too far away": 1, "bone length": 1}
    assert np.isfinite(found).sum() == np.isfinite(p).sum() - 6


def test_all_stages_together_end_near_the_truth():
    rig, p, uv, conf = seen(ring(), p=skeletons(160)[::10], noise=2.0)
    flips = np.zeros((4, 16, 3), bool)
    flips[1, :5] = True
    swapped = apply_flips(uv, flips, GROUPS)
    given = turned(rig, 3, degrees=1.0, metres=0.02)
    silhouettes = outlines(uv)
    found = solve(
        given, np.arange(16) / 6, swapped, conf, silhouettes, solve_settings()
    )
    medians = {name: median(error) for name, error in found.stages.items()}
    assert list(medians) == ["plain", "robust", "flips", "refined", "body"]
    assert medians["plain"] > 5
    assert medians["refined"] < 2.5
    assert found.flips[1, :5, 1:].all()
    error = np.linalg.norm(found.p - p, axis=-1)
    assert np.nanmedian(error) < 0.02


def test_nobody_seen_ends_without_joints_or_warnings():
    rig, _, uv, conf = seen(ring(), frames=3)
    found = solve(
        rig,
        np.arange(3.0),
        np.full_like(uv, np.nan),
        0 * conf,
        no_outlines(4, 3),
        solve_settings(),
    )
    assert np.isnan(found.p).all()
    assert (found.conf == 0).all()
    np.testing.assert_allclose(found.cameras.R, rig.R)


def biased_scene(frames: int = 30):
    """Landmarks off in the same direction in all frames of a camera, and noisy silhouettes."""
    rig, _, uv, conf = seen(ring(), frames=frames)
    silhouettes = outlines(uv, noise=0.3)
    bias = np.random.default_rng(2).normal(0, 6, (4, 1, uv.shape[2], 2))
    return rig, uv + bias, conf, silhouettes


def found_by(given, uv, conf, silhouettes):
    cameras, scaled = given.normalise(uv)
    time = np.arange(conf.shape[1]) / 30
    corrected = correct(cameras, scaled, conf, time)
    return refine(given, corrected, silhouettes, solve_settings())


def test_an_exact_calibration_is_kept_although_landmarks_are_biased():
    rig, uv, conf, silhouettes = biased_scene()
    found = found_by(rig, uv, conf, silhouettes)
    assert found.cameras is rig
    assert found.frontier[0] < 1


def test_silhouettes_of_few_pixels_do_not_move_an_exact_calibration():
    """Outlines of small images are off by parts of a pixel, which refined cameras would fit."""
    rig, _, uv, conf = seen(ring(ANGLES[:3], size=(96, 128)), frames=40)
    found = found_by(rig, uv, conf, outlines(np.floor(uv) + 0.5))
    assert found.cameras is rig


@pytest.mark.parametrize("moved", [[1], [0, 1, 2, 3]])
def test_a_disturbed_calibration_comes_back_within_half_a_pixel(moved):
    rig, uv, conf, silhouettes = biased_scene()
    given = rig
    for camera in moved:
        given = turned(given, camera, degrees=1.0, metres=0.03)
    found = found_by(given, uv, conf, silhouettes)
    before, after = found.frontier
    assert after < 0.5 * before

    # Pixels of true points, up to a similarity of the whole world.
    p = skeletons(30).reshape(-1, 3)
    seen_again = robust(found.cameras, rig.project(p)[0], np.ones((4, len(p))))
    assert np.median(seen_again.error) < 0.5


def two_cameras():
    """Two cameras, biased landmarks, and silhouettes of which one camera's are off by a pixel."""
    rig, _, uv, conf = seen(ring(ANGLES[:2]), frames=40)
    bias = np.random.default_rng(2).normal(0, 6, (2, 1, uv.shape[2], 2))
    shown = uv.copy()
    shown[1, ..., 1] += 1
    return rig, uv + bias, conf, outlines(shown, noise=0.3)


def test_one_pair_of_cameras_is_not_moved_by_what_masks_are_usually_off():
    rig, uv, conf, silhouettes = two_cameras()
    found = found_by(rig, uv, conf, silhouettes)
    assert found.frontier[0] > 0.5
    assert found.cameras is rig


def test_one_pair_of_cameras_that_was_moved_is_refined():
    rig, uv, conf, silhouettes = two_cameras()
    given = turned(rig, 1, degrees=2.0, metres=0.05)
    found = found_by(given, uv, conf, silhouettes)
    before, after = found.frontier
    assert after < 0.5 * before


def test_landmarks_refuse_cameras_that_wrong_silhouettes_would_turn():
    """One camera's silhouettes are of something else than the person alone."""
    rig, _, uv, conf = seen(ring(), frames=30)
    shown = uv.copy()
    shown[1] += (12, 25)
    noise = np.random.default_rng(3).normal(0, 0.5, uv.shape)
    found = found_by(rig, uv + noise, conf, outlines(shown, noise=0.3))
    turned_by, moved = camera_moves(rig, found.cameras)
    assert found.frontier[0] > 2
    assert turned_by.max() < 0.5
    assert moved.max() < 20


def test_without_silhouettes_the_given_cameras_are_kept():
    rig, uv, conf, _ = biased_scene(frames=8)
    given = turned(rig, 1, degrees=1.0, metres=0.03)
    found = found_by(given, uv, conf, no_outlines(4, 8))
    assert found.cameras is given
    assert np.isnan(found.frontier).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [("rotation_prior", 0), ("refinements", -1), ("smoothing", -1)],
)
def test_settings_out_of_range_are_named(name, value):
    with pytest.raises(ConfigError, match=name):
        solve_settings(**{name: value})
