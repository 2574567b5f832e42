"""The lifter of `gsgan.prepare.lifter`: 2D landmarks over time to three dimensions."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from one_person import turning, world_landmarks

from gsgan.body.lbs import axis_angle_to_matrix
from gsgan.prepare.lifter import HIP_JOINTS, Lifter, ray_rotation, with_lifter

FRAMES = 60
SCRIPT = Path(__file__).parents[2] / "scripts" / "learn_lifter.py"


def seen():
    """A person who turns: truth ``[F, 33, 3]`` in camera axes, offsets and weights."""
    truth = torch.from_numpy(turning(FRAMES))
    u = truth[..., :2] / truth[..., 2:]
    return truth, u, torch.ones(u.shape[:2], dtype=torch.float64)


def lifted(u, weight):
    """The lifter alone."""
    nothing = torch.full((*u.shape[:2], 3), torch.nan, dtype=u.dtype)
    return with_lifter(nothing, u, weight)


def error(found, truth, u, weight):
    """Median distance in metres, after the best scale of all frames."""
    own = truth - truth[:, HIP_JOINTS].mean(1, keepdim=True)
    own = own @ ray_rotation(u, weight)
    scale = (found * own).sum() / found.square().sum()
    return float((scale * found - own).norm(dim=-1).median())


def test_a_turning_person_is_lifted():
    truth, u, weight = seen()
    assert error(lifted(u, weight), truth, u, weight) < 0.08


def test_the_mean_with_a_detectors_guess_is_better_than_either():
    truth, u, weight = seen()
    world = torch.from_numpy(world_landmarks(truth.numpy()))
    own = world - world[:, HIP_JOINTS].mean(1, keepdim=True)
    both = with_lifter(world, u, weight)
    turned = own @ ray_rotation(u, weight)  # the detector's axes are the ray's
    alone = error(lifted(u, weight), truth, u, weight)
    assert error(both, truth, u, weight) < min(
        alone, error(turned, truth, u, weight)
    )


def test_the_scale_of_the_detector_does_not_count():
    truth, u, weight = seen()
    world = torch.from_numpy(world_landmarks(truth.numpy()))
    torch.testing.assert_close(
        with_lifter(world, u, weight), with_lifter(3 * world + 1, u, weight)
    )


def test_where_in_the_image_the_person_stands_does_not_count():
    """A camera that turns about its centre sees the same person elsewhere."""
    truth, u, weight = seen()
    turn = axis_angle_to_matrix(
        torch.tensor([[0.1, -0.3, 0.0]], dtype=torch.float64)
    )[0]
    moved = truth @ turn.mT
    beside = moved[..., :2] / moved[..., 2:]

    # In the axes of each camera; the middle of the landmarks is not quite the same ray.
    first = lifted(u, weight) @ ray_rotation(u, weight).mT
    second = lifted(beside, weight) @ ray_rotation(beside, weight).mT
    difference = second - first @ turn.mT
    assert difference.norm(dim=-1).median() < 0.03


def test_a_set_without_fingers_and_parts_of_the_face_is_lifted():
    """OpenPose's BODY_25."""
    truth, u, weight = seen()
    weight[:, [1, 3, 4, 6, 9, 10, *range(17, 23)]] = 0
    u = torch.where(weight[..., None] > 0, u, 0.0)
    assert error(lifted(u, weight), truth, u, weight) < 0.08


def test_landmarks_that_were_not_seen_are_not_read():
    _, u, weight = seen()
    weight[:, 15] = 0
    weight[7] = 0  # nobody was found in this frame
    found = lifted(torch.where(weight[..., None] > 0, u, 0.0), weight)
    u[:, 15] += 5
    u[7] = -3
    assert found.isfinite().all()
    torch.testing.assert_close(lifted(u, weight), found)


@pytest.mark.parametrize("frames", [1, 2, 200])
def test_any_number_of_frames_can_be_lifted(frames):
    _, u, weight = seen()
    rows = np.resize(np.arange(FRAMES), frames)
    assert lifted(u[rows], weight[rows]).shape == (frames, 33, 3)


def test_frames_far_away_in_time_do_not_count():
    _, u, weight = seen()
    changed = u.clone()
    changed[40:] += 0.1
    torch.testing.assert_close(
        lifted(changed, weight)[:26], lifted(u, weight)[:26]
    )


@pytest.mark.slow
def test_the_script_learns_weights_of_the_lifters_shape(tmp_path, monkeypatch):
    out = tmp_path / "lifter.npz"
    words = ["learn_lifter.py", "--steps", "2", "--out", str(out)]
    monkeypatch.setattr(sys, "argv", words)
    runpy.run_path(str(SCRIPT), run_name="__main__")
    state = Lifter().state_dict()
    learnt = np.load(out)
    assert set(learnt.files) == set(state)
    assert all(learnt[name].shape == x.shape for name, x in state.items())
