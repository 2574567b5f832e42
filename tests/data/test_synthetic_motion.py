"""The choreography of the synthetic person, its inverse kinematics and its held-out frames."""

from __future__ import annotations

import math
import re

import pytest
import torch

from gsgan.body.free import free_body
from gsgan.body.lbs import axis_angle_to_matrix
from gsgan.data.synthetic.choreography import COMBINATION, held_out, passage_names
from gsgan.data.synthetic.motion import (
    SIDES,
    matrix_to_axis_angle,
    motion,
    swing_twist,
    two_bone,
)
from gsgan.data.synthetic.scene_setup import Scene, Settings
from gsgan.scene import BodyPose

# Largest rotation of a person's joint against its parent, radians, the fingers' middle and last
# joints in one. The first match counts.
JOINT_LIMITS = (
    (r"root", math.pi),
    (r"spine\d\d", 0.45),
    (r"neck\d\d|head", 0.45),
    (r"clavicle|shoulder01", 0.45),
    (r"upperarm01", 2.6),
    (r"upperarm02", 1.2),
    (r"lowerarm01", 2.6),
    (r"lowerarm02|wrist", 1.2),
    (r"finger\d-\d", 1.9),
    (r"upperleg01", 2.2),
    (r"upperleg02", 0.9),
    (r"lowerleg01", 2.6),
    (r"foot", 1.0),
    (r".*", 0.5),
)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_joints_stay_within_their_limits(seed):
    theta, _, _ = motion(120, seed)
    largest = theta.norm(dim=-1).amax(0)
    for name, angle in zip(free_body().joint_names, largest.tolist(), strict=True):
        stem = name.split(".")[0]
        limit = next(limit for pattern, limit in JOINT_LIMITS if re.fullmatch(pattern, stem))
        assert angle <= limit, name


def test_knees_bend_forwards():
    body = free_body()
    theta, transl, _ = motion(120, 0)
    p = body.posed_landmarks(BodyPose(theta, transl))
    heading = torch.linalg.cross(
        p[:, 23] - p[:, 24], torch.tensor([0.0, 0.0, 1.0]).expand(120, 3)
    )  # right to left, times up
    for hip, knee, ankle in ((23, 25, 27), (24, 26, 28)):
        off = p[:, knee] - (p[:, hip] + p[:, ankle]) / 2
        assert ((off * heading).sum(-1) > 0).all()


def test_motion_is_smooth():
    theta, transl, _ = motion(1680, 0)  # 48 frames a second
    step = (theta[1:] - theta[:-1]).norm(dim=-1).max()
    assert step < 0.3
    assert (transl[1:] - transl[:-1]).norm(dim=-1).max() < 0.05


def test_feet_stay_above_the_floor():
    theta, transl, _ = motion(60, 0)
    v = free_body().posed_vertices(BodyPose(theta, transl))
    assert v[..., 2].min() > -0.005


def test_fingers_move_while_signing():
    theta, _, passages = motion(60, 0)
    now = [i for i, name in enumerate(passages) if name == "signing"]
    for side in SIDES:
        finger = free_body().joint_names.index(f"finger2-1.{side}")
        assert theta[now, finger].norm(dim=-1).std() > 0.1


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_every_camera_sees_the_whole_motion(seed):
    """Cameras are placed by fewer moments than this: those between them must fit as well."""
    scene = Scene(Settings(frames=350, test_frames=60, seed=seed))
    for frame in range(0, 350, 5):
        vertices = scene.vertices(frame)[::23]
        for view in scene.views.values():
            pixels = view.project(vertices)
            assert pixels.min() > 1
            assert pixels.max() < 127


def test_freestyle_has_poses_of_no_other_passage():
    theta, _, names = motion(350, 0)
    turned = axis_angle_to_matrix(theta[:, 1:]).flatten(1)  # without the root
    free = torch.tensor([name == "freestyle" for name in names])
    named = turned[~free]
    nearest = torch.cdist(turned[free], named).amin(dim=1)
    within = torch.cdist(named, named).fill_diagonal_(torch.inf).amin(dim=1)
    assert nearest.median() > 3 * within.median()


def test_held_out_frames_are_blocks_and_one_whole_passage():
    test, names = held_out(84, 21), passage_names(84)
    assert len(test) == len(set(test)) == 21
    combination = [i for i, n in enumerate(names) if n == COMBINATION]
    assert set(combination) <= set(test)
    rest = [i for i in test if i not in combination]
    assert all(i - 1 in rest or i + 1 in rest for i in rest)  # blocks, not single frames
    assert {names[i] for i in range(84) if i not in test} == set(names) - {COMBINATION}


@pytest.mark.parametrize("frames", [1, 2, 7, 30])
def test_held_out_count_is_exact(frames):
    for count in range(frames):
        test = held_out(frames, count)
        assert len(set(test)) == count
        assert set(test) < set(range(frames))


def test_two_bone_reaches_its_target_with_the_right_lengths():
    target = torch.tensor([[0.3, -0.2, -0.3], [9.0, 0, 0]], dtype=torch.float64)
    pole = torch.tensor([[0.0, 1, 0], [0, 1, 0]], dtype=torch.float64)
    upper, lower = two_bone(target, pole, 0.3, 0.25)
    end = 0.3 * upper + 0.25 * lower
    torch.testing.assert_close(end[0], target[0], atol=1e-12, rtol=0)
    torch.testing.assert_close(end[1, 0], torch.tensor(0.99 * 0.55, dtype=torch.float64))
    assert upper[0, 1] > target[0, 1] / target[0].norm()  # bends to the pole's side


def test_swing_and_twist_multiply_to_the_rotation():
    axis = torch.tensor([0.0, 0.6, -0.8], dtype=torch.float64)
    R = axis_angle_to_matrix(torch.tensor([[0.7, -0.2, 0.4]], dtype=torch.float64))
    swing, angle = swing_twist(R, axis)
    torch.testing.assert_close(swing @ axis_angle_to_matrix(angle[:, None] * axis), R)
    torch.testing.assert_close(swing @ axis, R @ axis)
    torch.testing.assert_close(
        matrix_to_axis_angle(R), torch.tensor([[0.7, -0.2, 0.4]], dtype=torch.float64)
    )
