"""Cameras that are found from the person: synthetic views of known cameras."""

import numpy as np
import pytest
from one_person import turning
from scipy.spatial.transform import Rotation

from gsgan.prepare.camera_array import CameraArray, film_camera
from gsgan.prepare.from_person import calibrate_from_person
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
    return uv, np.ones(uv.shape[:3])


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
    uv, conf = seen_by(truth, noise=0.005, swaps=0.15)
    conf[:, :3] = 0  # nobody is there at first
    found = calibrate_from_person(truth, uv, conf, FOCAL + 3)
    turned, off = differences(found.cameras, truth)
    assert turned < 1.0
    assert off < 0.04


def test_two_cameras_need_their_focal_length():
    truth = ring((0, 50))
    uv, conf = seen_by(truth)
    with pytest.raises(DataError, match="focal="):
        calibrate_from_person(truth, uv, conf, None)
    found = calibrate_from_person(truth, uv, conf, FOCAL)
    turned, _ = differences(found.cameras, truth)
    assert turned < 2.0  # the second camera's is 2 mm longer


def test_cameras_that_share_no_frame_are_refused():
    truth = ring((0, 60, 120))
    uv, conf = seen_by(truth, frames=30)
    conf[0, 10:], conf[1, :10], conf[1, 20:], conf[2, :20] = 0, 0, 0, 0
    with pytest.raises(DataError, match="frame numbers"):
        calibrate_from_person(truth, uv, conf, None)
