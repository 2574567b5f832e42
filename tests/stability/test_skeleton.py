"""Hard skeletons: right against float64, no jump where none is forced, and motions that commute."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from gsgan.bench.cases.crossings import CROSSINGS, Crossing
from gsgan.bench.cases.skeleton import SKELETON, few_points
from gsgan.skeleton import MEDIAPIPE33, Densify, bone_frames, omega
from gsgan.skeleton.frames import BoneFrames
from stability.judged import assert_as_expected, each
from stability.motions import ANGLES, METRES, assert_rotation, rigid, skeletons

CPU = torch.device("cpu")
TWISTS = ("none", "hinge")
property_test = settings(max_examples=25, deadline=None, derandomize=True)


@each(SKELETON)
def test_float32(case, backend):
    assert_as_expected(case, backend)


def all_frames(frames: BoneFrames) -> Tensor:
    return torch.cat([frames.hubs, frames.limbs, frames.local, frames.torso[:, None]], dim=1)


def turns(crossing: Crossing, steps: int, twist: str) -> Tensor:
    """How far the frame that turns most goes at each step, in Frobenius norm."""
    frames = all_frames(bone_frames(crossing.poses(steps), twist=twist))
    return (frames[1:] - frames[:-1]).flatten(2).norm(dim=-1).amax(dim=1)


@pytest.mark.parametrize("twist", TWISTS)
@pytest.mark.parametrize("crossing", CROSSINGS, ids=lambda c: c.name)
def test_frames_turn_by_bounded_steps_through_a_singularity(crossing, twist):
    """Ten times finer steps turn ten times less: no jump, but for the ones that are forced."""
    for steps in (400, 4000):
        step = 2 / (steps - 1)
        over = turns(crossing, steps, twist) > crossing.rate * step
        # a step of a coarse path is counted as a jump only where it is one
        assert int(over.sum()) <= crossing.jumps


@pytest.mark.parametrize("crossing", [c for c in CROSSINGS if c.jumps], ids=lambda c: c.name)
def test_forced_jumps_are_there_and_keep_the_bones_directions(crossing):
    """What the note says: some frame jumps, by at most half a turn, and no bone leaves its line."""
    largest = max(float(turns(crossing, 4000, twist).max()) for twist in TWISTS)
    assert 1 < largest <= 8**0.5 + 1e-9  # half a turn is √8
    p = crossing.poses(401)
    start, end = (list(ends) for ends in zip(*MEDIAPIPE33.limbs, strict=True))
    bones = torch.nn.functional.normalize(p[:, end] - p[:, start], dim=-1)
    rest = torch.tensor(MEDIAPIPE33.rest_directions, dtype=torch.float64)
    pointing = (bone_frames(p).limbs @ rest.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(pointing, bones, atol=1e-9, rtol=0)


def test_a_fold_jumps_on_a_hair_only():
    """0.8 degrees off the fold the roll is continuous; within it, it is fixed."""
    (fold,) = (c for c in CROSSINGS if c.name == "a forearm through its fold")
    over = (turns(fold, 4000, "none") > 1).nonzero().flatten()
    angle = 0.1 * (2 * over / 3999 - 1).abs()
    assert len(over) == 2
    torch.testing.assert_close(angle, torch.full_like(angle, 0.01414), atol=1e-4, rtol=0)


@given(skeletons(trunk=True))
@property_test
def test_any_skeleton_has_rotations_for_frames_and_finite_slopes(p):
    leaf = p.float().requires_grad_()
    densify = few_points(torch.float32, CPU)
    total = torch.zeros(())
    for twist in TWISTS:
        frames = bone_frames(leaf, twist=twist)
        assert_rotation(all_frames(frames).detach(), 2e-5)
        points = densify(leaf, None, frames)
        assert points.means.isfinite().all()
        assert (points.scales > 0).all()
        code = omega(leaf, None, None, frame="world", frames=frames)
        total = total + points.means.sum() + points.scales.sum() + (code * code.detach()).sum()
    total.backward()
    assert leaf.grad.isfinite().all()


@given(skeletons(), ANGLES, METRES)
@property_test
def test_frames_and_points_turn_and_move_with_the_skeleton(p, angles, metres):
    moved, R = rigid(p, angles, metres)
    densify: Densify = few_points(torch.float64, CPU)
    for twist in TWISTS:
        a, b = bone_frames(p, twist=twist), bone_frames(moved, twist=twist)
        torch.testing.assert_close(b.limbs, R @ a.limbs, atol=1e-6, rtol=0)
        torch.testing.assert_close(b.hubs, R @ a.hubs, atol=1e-6, rtol=0)
        torch.testing.assert_close(b.local, a.local, atol=1e-6, rtol=0)
        here, there = densify(p, None, a), densify(moved, None, b)
        shift = moved - p @ R.mT
        expected = here.means @ R.mT + shift[:, :1]
        torch.testing.assert_close(there.means, expected, atol=1e-6, rtol=0)
        torch.testing.assert_close(there.scales, here.scales, atol=1e-9, rtol=0)


@given(skeletons())
@property_test
def test_a_mirrored_skeleton_has_mirrored_frames(p):
    """Left for right and x for -x: frames ``M R M``, lengths the same, on the other side."""
    M = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
    mirror = list(MEDIAPIPE33.mirror)
    index = {limb: k for k, limb in enumerate(MEDIAPIPE33.limbs)}
    other = [index[(mirror[a], mirror[b])] for a, b in MEDIAPIPE33.limbs]
    for twist in TWISTS:
        a, b = bone_frames(p, twist=twist), bone_frames((p @ M)[:, mirror], twist=twist)
        torch.testing.assert_close(b.hubs, M @ a.hubs @ M, atol=1e-6, rtol=0)
        torch.testing.assert_close(b.limbs, M @ a.limbs[:, other] @ M, atol=1e-6, rtol=0)
        torch.testing.assert_close(b.lengths, a.lengths[:, other], atol=1e-9, rtol=0)


@pytest.mark.parametrize("twist", TWISTS)
def test_gradcheck_below_the_least_length(twist):
    """Where baselines fade into their stand-ins the slope is the function's own."""
    p = torch.cat([c.poses(7)[[2, 4]] for c in CROSSINGS if not c.jumps]).requires_grad_()

    def values(p: Tensor) -> tuple[Tensor, ...]:
        frames = bone_frames(p, twist=twist)
        points = few_points(torch.float64, CPU)(p, None, frames)
        return frames.hubs, frames.limbs, frames.torso, points.means, points.scales

    assert torch.autograd.gradcheck(values, (p,), fast_mode=True, eps=1e-8, atol=1e-4)
