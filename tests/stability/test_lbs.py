"""Skinning: what holds for any pose and weights."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsgan.body import axis_angle_to_matrix, blend_transforms, forward_kinematics, skin
from stability.cases.lbs import BONES, PARENTS
from stability.cases.raster import rotation
from stability.motions import ANGLES, METRES, assert_rotation

JOINTS = torch.tensor([[0.0, 0, 0], [0.3, 0, 0], [0.6, 0, 0]], dtype=torch.float64)
POINTS = torch.tensor(
    [[0.3, 0.04, 0], [0.6, 0, 0.04], [0.2, 0.03, 0.02], [0.7, 0, 0.02]], dtype=torch.float64
)
TURNS = st.lists(
    st.one_of(st.floats(-6.3, 6.3), st.sampled_from([0.0, 1e-9, 1e-3, 3.141592653589793])),
    min_size=9,
    max_size=9,
)
WEIGHTS = st.lists(st.floats(1e-6, 1.0), min_size=8, max_size=8)
property_test = settings(max_examples=12, deadline=None, derandomize=True)


def posed(theta: Tensor, transl: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    R = axis_angle_to_matrix(theta)
    return blend_transforms(forward_kinematics(JOINTS, PARENTS, R, transl), BONES, weights)


def made(turns: list[float], weights: list[float]) -> tuple[Tensor, Tensor, Tensor]:
    theta = torch.tensor(turns, dtype=torch.float64).view(1, 3, 3)
    transl = torch.zeros(1, 3, dtype=torch.float64)
    return theta, transl, torch.tensor(weights, dtype=torch.float64).view(4, 2)


@given(TURNS, WEIGHTS, st.floats(1e-3, 1e3))
@property_test
def test_only_the_proportion_of_weights_counts(turns, weights, factor):
    theta, transl, weights = made(turns, weights)
    A, t = posed(theta, transl, weights)
    again, there = posed(theta, transl, weights * factor)
    torch.testing.assert_close(again, A, atol=1e-12, rtol=0)
    torch.testing.assert_close(there, t, atol=1e-12, rtol=0)


@given(TURNS, WEIGHTS, ANGLES, METRES)
@property_test
def test_turning_and_moving_all_bones_turns_and_moves_every_point(turns, weights, angles, metres):
    theta, transl, weights = made(turns, weights)
    bones = forward_kinematics(JOINTS, PARENTS, axis_angle_to_matrix(theta), transl)
    R, shift = rotation(angles), torch.tensor(metres, dtype=torch.float64)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = R, shift
    here = skin(POINTS, *blend_transforms(bones, BONES, weights))
    there = skin(POINTS, *blend_transforms(motion @ bones, BONES, weights))
    torch.testing.assert_close(there, here @ R.mT + shift, atol=1e-9, rtol=0)


@given(TURNS, WEIGHTS)
@property_test
def test_blends_never_stretch_and_slopes_are_finite(turns, weights):
    """A mean of rotations has no singular value above 1; one bone's own is a rotation."""
    theta, transl, weights = made(turns, weights)
    theta.requires_grad_()
    A, t = posed(theta, transl, weights)
    assert float(torch.linalg.svdvals(A.detach()).max()) <= 1 + 1e-9
    assert_rotation(A.detach()[0, 3], 1e-9)  # both of its bones are the same one
    skin(POINTS, A, t).square().sum().backward()
    assert theta.grad.isfinite().all()
