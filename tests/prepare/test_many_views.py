"""One body from all views, and motion that does not go on over a cut."""

import numpy as np
import torch
from capture_scenes import ring, seen
from make import skeletons

from gsgan.prepare.many_views import with_cuts
from gsgan.prepare.solve import body_joints
from gsgan.prepare.triangulate import robust


def solved(noise: float, p: np.ndarray, weight: np.ndarray | None = None):
    """Joints by triangulation and by the body, ``[F, 33, 3]`` metres."""
    rig, _, uv, conf = seen(ring(), p=p, noise=noise)
    rig, uv = rig.normalise(uv)
    conf = conf if weight is None else conf * weight
    flat = robust(rig, uv.reshape(4, -1, 2), conf.reshape(4, -1))
    points = flat.p.reshape(p.shape)
    time = np.arange(len(p)) / 10
    return points, body_joints(rig, uv, conf, points, time, noise=2.0)


def test_the_body_has_less_noise_than_triangulated_joints():
    p = skeletons(20)
    points, found = solved(8.0, p)
    noise = np.linalg.norm(points - p, axis=-1)
    error = found - p
    error -= error.mean(0)
    assert np.median(np.linalg.norm(error, axis=-1)) < 0.8 * np.median(noise)


def test_a_joint_that_nobody_sees_is_where_the_body_has_it():
    p = skeletons(20)
    weight = np.ones((4, 20, 33))
    weight[:, 5:8, 13] = 0
    points, found = solved(1.0, p, weight)
    assert np.isnan(points[5:8, 13]).all()
    error = np.linalg.norm(found - p, axis=-1)
    assert np.isfinite(found).all()
    assert error[5:8, 13].max() < 0.06


def test_frames_without_a_trunk_stay_missing():
    p = skeletons(12)
    weight = np.ones((4, 12, 33))
    weight[:, 4] = 0
    _, found = solved(1.0, p, weight)
    assert np.isnan(found[4]).all()
    assert np.isfinite(np.delete(found, 4, axis=0)).all()


def test_legs_outside_every_image_stay_missing_and_the_upper_body_is_solved():
    p = skeletons(20)
    weight = np.ones((4, 20, 33))
    weight[:, :, 23:] = 0
    _, found = solved(1.0, p, weight)
    assert np.isnan(found[:, 23:]).all()
    error = np.linalg.norm(found - p, axis=-1)[:, :23]
    assert np.median(error) < 0.02


def test_a_cut_is_a_gap_in_time_and_quick_motion_is_none():
    p = torch.from_numpy(skeletons(20))
    time = torch.arange(20, dtype=torch.float64) / 5
    torch.testing.assert_close(with_cuts(p, time), time)
    p[12:] += torch.tensor([1.0, 0.5, 0.0])
    steps = with_cuts(p, time).diff()
    assert steps[11] > 5
    assert (torch.cat([steps[:11], steps[12:]]) < 0.21).all()
