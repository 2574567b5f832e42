"""The filter of a motion: body poses follow the joints, and frames apart start anew."""

import numpy as np
import pytest
import torch

from gsgan.run.drive import Drive, smooth
from gsgan.scene import BodyPose


@pytest.fixture
def drive() -> Drive:
    """Frames 0 to 4 and 20 to 24 of joints that move by 1 cm per frame."""
    p = np.zeros((10, 33, 3))
    p += 0.01 * np.arange(10)[:, None, None]
    pose = BodyPose(torch.zeros(10, 2, 3), torch.zeros(10, 3))
    numbers = [*range(5), *range(20, 25)]
    return Drive(p, np.ones((10, 33)), pose, numbers, "a motion")


def test_it_is_off_by_default(compose, drive):
    for command in ("render", "view"):
        assert smooth(compose(command, "run=x").smooth, drive, 30.0) is drive


@pytest.mark.parametrize("command", ["render", "view"])
def test_body_poses_follow_the_joints_and_gaps_start_anew(
    compose, drive, command
):
    found = smooth(
        compose(command, "run=x", "smooth.enabled=true").smooth, drive, 30.0
    )
    assert found.body is None
    assert found.text == "a motion, smoothed"
    late = np.abs(found.p - drive.p).max(axis=(1, 2))
    np.testing.assert_array_equal(late[[0, 5]], 0)
    assert (late[[1, 2, 3, 4, 6, 7, 8, 9]] > 0.001).all()
