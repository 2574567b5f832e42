"""Cameras that are found from the person: synthetic views of known cameras."""

import json

import numpy as np
import pytest
from capture_scenes import options, quiet, write_project
from make import skeletons
from one_person import turning
from scipy.spatial.transform import Rotation

from gsgan.prepare import from_person
from gsgan.prepare.camera_array import CameraArray, film_camera
from gsgan.prepare.from_person import calibrate_from_person
from gsgan.prepare.run import prepare
from gsgan.skeleton.joints import FLIP_GROUPS
from gsgan.utils.errors import DataError

FOCAL = 35.0  # millimetres on film
SIZES = ((720, 1280), (1280, 720), (480, 640))  # pixels, of unlike cameras


def ring(angles) -> list:
    """Cameras 3.5 m from the origin, at eye level, that look at the person's hips."""
    cameras = []
    for k, angle in enumerate(np.radians(angles)):
        centre = np.array([3.5 * np.cos(angle), 3.5 * np.sin(angle), 1.5])
        z = np.array([0.0, 0.0, 0.9]) - centre
        z /= np.linalg.norm(z)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        base = film_camera(f"cam{k}", SIZES[k % 3], FOCAL + 2 * k)
        cameras.append(
            type(base)(base.name, base.K, R, -R @ centre, base.dist, base.size)
        )
    return cameras


def seen_by(cameras, frames: int = 50, noise: float = 0.0, swaps: float = 0.0):
    """Landmarks ``[C, F, 33, 2]`` with noise (share of the person's size) and swapped sides."""
    # The person's film camera looks along z, with y downwards; here z is upwards.
    p = turning(frames)[..., [0, 2, 1]] * [1, 1, -1] + [0, -3.2, 0.9]
    rng = np.random.default_rng(0)
    uv, _ = CameraArray.of(cameras).project(p.reshape(-1, 3))
    uv = uv.reshape(len(cameras), frames, 33, 2)
    tall = np.ptp(uv[..., 1], axis=2)[..., None, None]
    uv = uv + noise * tall * rng.normal(size=uv.shape)
    for c, f in np.argwhere(rng.random(uv.shape[:2]) < swaps):
        for pairs in FLIP_GROUPS:
            for left, right in pairs:
                uv[c, f, [left, right]] = uv[c, f, [right, left]]
    return uv, np.ones(uv.shape[:3]), np.arange(frames) / 12


def differences(found, truth):
    """Degrees, and shares of the mean distance, of each camera after a similarity of the world."""
    a, b = CameraArray.of(found), CameraArray.of(truth)
    world = Rotation.from_matrix(b.R.mT @ a.R).mean().as_matrix()
    turned = Rotation.from_matrix(a.R @ world.T @ b.R.mT).magnitude()
    mine = (a.centres - a.centres.mean(0)) @ world.T
    theirs = b.centres - b.centres.mean(0)
    scale = (mine * theirs).sum() / (mine**2).sum()
    off = np.linalg.norm(scale * mine - theirs, axis=1)
    return np.degrees(turned).max(), off.max() / np.linalg.norm(
        theirs, axis=1
    ).mean()


def test_exact_landmarks_give_the_exact_cameras():
    truth = ring((0, 70, 150))
    found = calibrate_from_person(truth, *seen_by(truth), None)
    turned, off = differences(found.cameras, truth)
    focal = [
        f.K[0, 0] / t.K[0, 0] for f, t in zip(found.cameras, truth, strict=True)
    ]
    assert turned < 0.1
    assert off < 0.005
    np.testing.assert_allclose(focal, 1, atol=0.005)
    assert found.error.max() < 0.1


def test_noise_and_swapped_sides_leave_a_usable_calibration():
    """Half a percent of the person's size, a seventh of all views with left and right swapped."""
    truth = ring((0, 60, 120, 220))
    uv, conf, time = seen_by(truth, noise=0.005, swaps=0.15)
    conf[:, :3] = 0  # nobody is there at first
    found = calibrate_from_person(truth, uv, conf, time, FOCAL + 3)
    turned, off = differences(found.cameras, truth)
    assert turned < 1.0
    assert off < 0.04


def test_two_cameras_need_their_focal_length():
    truth = ring((0, 50))
    uv, conf, time = seen_by(truth)
    with pytest.raises(DataError, match="focal="):
        calibrate_from_person(truth, uv, conf, time, None)
    found = calibrate_from_person(truth, uv, conf, time, FOCAL)
    turned, _ = differences(found.cameras, truth)
    assert turned < 2.0  # the second camera's is 2 mm longer


def test_cameras_that_share_no_frame_are_refused():
    truth = ring((0, 60, 120))
    uv, conf, time = seen_by(truth, frames=30)
    for camera, frame in enumerate((0, 10, 20)):
        alone = np.zeros(30)
        alone[frame : frame + 10] = 1
        conf[camera] *= alone[:, None]
    with pytest.raises(DataError, match="frame numbers"):
        calibrate_from_person(truth, uv, conf, time, None)


def test_videos_without_a_calibration_become_a_capture(tmp_path):
    """Of unlike focal guesses the right one is found, and the height gives the scale."""
    project = write_project(tmp_path / "project", cameras=4, frames=16)
    (project / "cameras.json").unlink()
    out = prepare(options(project, calibration="person", height=1.8), quiet())
    found = np.load(out / "landmarks3d.npz")
    p, truth = found["p"], skeletons(16)[found["frame_id"]]
    a, b = p[:, 11:29], truth[:, 11:29]
    mine = np.linalg.norm(a[:, :, None] - a[:, None], axis=-1)
    theirs = np.linalg.norm(b[:, :, None] - b[:, None], axis=-1)
    ratio = (mine / np.where(theirs > 0.2, theirs, np.nan)).ravel()
    ratio = ratio[np.isfinite(ratio)]
    assert np.quantile(abs(ratio / np.median(ratio) - 1), 0.9) < 0.05
    notes = json.loads((out / "prepare.json").read_text())["notes"]
    assert sum("found from the person" in note for note in notes) == 4


def test_a_start_from_which_no_camera_is_placed_is_not_the_end(monkeypatch):
    truth = ring((0, 70, 150))
    solution = from_person._solution

    def fails_at_first(guess, *rest):
        if guess[0].K[0, 0] < 900:
            raise DataError("cannot be placed")
        return solution(guess, *rest)

    monkeypatch.setattr(from_person, "_solution", fails_at_first)
    found = calibrate_from_person(truth, *seen_by(truth), None)
    assert found.error.max() < 0.1
