"""The distance from the training poses: its unit, what it ignores, and what it does not."""

import pytest
import torch

from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.tensors import constants
from gsgan.skeleton.training_poses import NOISE, training_poses

REST = constants(MEDIAPIPE33, torch.device("cpu"), torch.float64).rest * 1.7
WRIST = MEDIAPIPE33.names.index("left_wrist")


def moved(joint: int, metres: torch.Tensor, axis: int = 0) -> torch.Tensor:
    p = REST.repeat(len(metres), 1, 1)
    p[:, joint, axis] += metres
    return p


@pytest.fixture(scope="module")
def poses():
    """Of a capture in which one wrist moves to and fro and up and down, each 20 cm RMS."""
    p = moved(WRIST, torch.tensor([-0.2, 0.2, 0.2, -0.2]).double())
    p[:, WRIST, 2] += torch.tensor([-0.2, -0.2, 0.2, 0.2]).double()
    return training_poses(p)


def test_the_training_poses_are_one_deviation_away_and_the_distance_is_linear(
    poses,
):
    steps = torch.tensor([0.0, 0.2, 0.4, 1.0]).double()
    found = poses.distance(moved(WRIST, steps))
    # in one of the two directions
    torch.testing.assert_close(found, steps / 0.2 / 2**0.5)


def test_a_direction_that_never_varied_counts_as_varying_by_the_noise(poses):
    far = poses.distance(moved(WRIST, torch.tensor([NOISE]).double(), axis=1))
    assert float(far) == pytest.approx(2**-0.5, abs=0.05)


def test_place_and_turn_of_the_whole_body_and_fingers_do_not_count(poses):
    p = moved(WRIST, torch.tensor([0.3]).double())
    angle = torch.tensor(0.7).double()
    c, s, z, o = angle.cos(), angle.sin(), angle * 0, angle * 0 + 1
    turn = torch.stack([c, -s, z, s, c, z, z, z, o]).view(3, 3)
    whole = torch.cat([p @ turn.T + 2, torch.randn(1, 42, 3).double()], dim=1)
    torch.testing.assert_close(poses.distance(whole), poses.distance(p))


def test_a_single_training_frame_has_a_distance_too():
    found = training_poses(REST[None])
    assert float(found.distance(REST[None])) == 0
    assert (
        0
        < float(found.distance(moved(WRIST, torch.tensor([0.3]).double())))
        < 100
    )
