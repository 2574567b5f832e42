"""Hard skeletons: no jump of a frame where none is forced, and motions that commute."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from gsgan.skeleton import MEDIAPIPE33, bone_frames, omega
from gsgan.skeleton.frames import MIN_LENGTH, BoneFrames
from stability.cases.crossings import CROSSINGS, poses
from stability.cases.poses import DEGENERATE, noisy
from stability.cases.raster import rotation
from stability.cases.skeleton import few_points

CPU = torch.device("cpu")
XYZ = st.tuples(*[st.floats(-3.1, 3.1)] * 3)

FADED = 20.0 * 1e-3 / MIN_LENGTH
"""Frobenius norm of a frame's change over ``step / MIN_LENGTH``, where a baseline fades to its
stand-in: between the two, ``s u + (1 - s²) f``, a direction turns at a rate of at most 3 over a
length that stays above 0.4 on these paths, its stand-in may turn too; a frame changes by √2 of
that, and a limb that swings from it by up to twice as much."""

SWUNG = 8.0
"""The same over an angle: a half turn doubles it, in the Frobenius norm it counts √2, and a hand
swings from a forearm that swings from an arm."""

# By crossing: a bound on how fast any frame turns, in Frobenius norm per unit of the path, and how
# often a frame may turn at once all the same, because no continuous choice exists.
BOUNDS = {
    "a bone through zero length": (3 * FADED, 0),
    "an arm through straight": (0.1 * SWUNG, 0),
    "a forearm past its fold, two degrees beside": (0.1 / 0.035 * SWUNG, 0),
    "a forearm through its fold": (0.1 * SWUNG, 2),
    "shoulders through the spine's direction": (2 * FADED, 0),
    "shoulders through the spine's direction, against the hips": (2 * FADED, 2),
    "left and right changing places": (2 * FADED, 0),
    "hips through the shoulders": (4 * FADED, 0),
    "a nose through the ears' line": (4 * FADED, 0),
    "ears through each other": (4 * FADED, 0),
    "shoulders round to the back of the hips": (0.2 * SWUNG, 2),
}
EASY_JOINTS = [j for j in range(33) if j not in (11, 12, 23, 24)]
"""All but the trunk's: where those collapse, the world's axes stand in, which do not turn."""


@st.composite
def skeletons(draw: st.DrawFn, trunk: bool = False) -> Tensor:
    """``[1, 33, 3]`` float64: noisy, with joints that coincide or bones in line; with ``trunk`` the
    trunk may collapse too, or the skeleton be one of the hard ones."""
    joints = st.sampled_from(list(range(33)) if trunk else EASY_JOINTS)
    p = noisy(
        draw(st.integers(0, 2**16)),
        sigma=draw(st.sampled_from([0.0, 1e-4, 0.05, 0.3])),
    )
    if trunk and draw(st.booleans()):
        p = DEGENERATE[draw(st.sampled_from(sorted(DEGENERATE)))].clone()
    for a, b in draw(st.lists(st.tuples(joints, joints), max_size=4)):
        p[:, a] = p[:, b]  # coincident
    for a, b, c in draw(
        st.lists(st.tuples(joints, joints, joints), max_size=2)
    ):
        p[:, a] = p[:, b] + draw(st.sampled_from([-1.0, 0.5, 1.0, 2.0])) * (
            p[:, c] - p[:, b]
        )
    return p


def all_frames(frames: BoneFrames) -> Tensor:
    return torch.cat(
        [frames.hubs, frames.limbs, frames.local, frames.torso[:, None]], dim=1
    )


def along(crossing: str, steps: int) -> Tensor:
    return poses(CROSSINGS[crossing][0], steps)


def turns(crossing: str, steps: int) -> Tensor:
    """How far the frame that turns most goes at each step, in Frobenius norm."""
    frames = all_frames(bone_frames(along(crossing, steps)))
    return (frames[1:] - frames[:-1]).flatten(2).norm(dim=-1).amax(dim=1)


@pytest.mark.parametrize("crossing", CROSSINGS)
def test_frames_turn_by_bounded_steps_through_a_singularity(crossing):
    """Ten times finer steps turn ten times less: no jump, but for the ones that are forced."""
    rate, jumps = BOUNDS[crossing]
    for steps in (400, 4000):
        step = 2 / (steps - 1)
        over = turns(crossing, steps) > rate * step
        # a step of a coarse path is counted as a jump only where it is one
        assert int(over.sum()) <= jumps


@pytest.mark.parametrize(
    "crossing", [name for name, (_, jumps) in BOUNDS.items() if jumps]
)
def test_forced_jumps_are_there_and_keep_the_bones_directions(crossing):
    """What the note says: some frame jumps, by at most half a turn, and no bone leaves its line."""
    largest = float(turns(crossing, 4000).max())
    assert 1 < largest <= 8**0.5 + 1e-9  # half a turn is √8
    p = along(crossing, 401)
    start, end = (list(ends) for ends in zip(*MEDIAPIPE33.limbs, strict=True))
    bones = torch.nn.functional.normalize(p[:, end] - p[:, start], dim=-1)
    rest = torch.tensor(MEDIAPIPE33.rest_directions, dtype=torch.float64)
    pointing = (bone_frames(p).limbs @ rest.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(pointing, bones, atol=1e-9, rtol=0)


def test_a_fold_jumps_on_a_hair_only():
    """0.8 degrees off the fold the roll is continuous; within it, it is fixed."""
    over = (turns("a forearm through its fold", 4000) > 1).nonzero().flatten()
    angle = 0.1 * (2 * over / 3999 - 1).abs()
    assert len(over) == 2
    torch.testing.assert_close(
        angle, torch.full_like(angle, 0.01414), atol=1e-4, rtol=0
    )


@given(skeletons(trunk=True))
def test_any_skeleton_has_rotations_for_frames_and_finite_slopes(p):
    leaf = p.float().requires_grad_()
    densify = few_points(torch.float32, CPU)
    frames = bone_frames(leaf)
    R = all_frames(frames).detach()
    torch.testing.assert_close(
        R.mT @ R, torch.eye(3).expand_as(R), atol=2e-5, rtol=0
    )
    assert (torch.linalg.det(R) > 0).all()
    points = densify(leaf, None, frames)
    assert points.means.isfinite().all()
    assert (points.scales > 0).all()
    code = omega(
        leaf, None, torch.eye(3)[None].expand(len(leaf), 3, 3), frames=frames
    )
    total = (
        points.means.sum() + points.scales.sum() + (code * code.detach()).sum()
    )
    total.backward()
    assert leaf.grad.isfinite().all()


@given(skeletons(), XYZ, XYZ)
def test_frames_and_points_turn_and_move_with_the_skeleton(p, angles, metres):
    R = rotation(angles)
    moved = p @ R.mT + torch.tensor(metres, dtype=p.dtype)
    densify = few_points(torch.float64, CPU)
    a, b = bone_frames(p), bone_frames(moved)
    torch.testing.assert_close(b.limbs, R @ a.limbs, atol=1e-6, rtol=0)
    torch.testing.assert_close(b.hubs, R @ a.hubs, atol=1e-6, rtol=0)
    torch.testing.assert_close(b.local, a.local, atol=1e-6, rtol=0)
    here, there = densify(p, None, a), densify(moved, None, b)
    shift = moved - p @ R.mT
    expected = here.means @ R.mT + shift[:, :1]
    torch.testing.assert_close(there.means, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(there.scales, here.scales, atol=1e-9, rtol=0)
    torch.testing.assert_close(there.frames, R @ here.frames, atol=1e-6, rtol=0)
    torch.testing.assert_close(
        there.normals, here.normals @ R.mT, atol=1e-6, rtol=0
    )
    torch.testing.assert_close(there.local(), here.local(), atol=1e-6, rtol=0)


@given(skeletons())
def test_a_mirrored_skeleton_has_mirrored_frames(p):
    """Left for right and x for -x: frames ``M R M``, lengths the same, on the other side."""
    M = torch.diag(torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64))
    mirror = list(MEDIAPIPE33.mirror)
    index = {limb: k for k, limb in enumerate(MEDIAPIPE33.limbs)}
    other = [index[(mirror[a], mirror[b])] for a, b in MEDIAPIPE33.limbs]
    a, b = bone_frames(p), bone_frames((p @ M)[:, mirror])
    torch.testing.assert_close(b.hubs, M @ a.hubs @ M, atol=1e-6, rtol=0)
    torch.testing.assert_close(
        b.limbs, M @ a.limbs[:, other] @ M, atol=1e-6, rtol=0
    )
    torch.testing.assert_close(
        b.lengths, a.lengths[:, other], atol=1e-9, rtol=0
    )


def test_gradcheck_below_the_least_length():
    """Where baselines fade into their stand-ins the slope is the function's own."""
    smooth = [name for name, (_, jumps) in BOUNDS.items() if not jumps]
    p = torch.cat([along(name, 7)[[2, 4]] for name in smooth]).requires_grad_()

    def values(p: Tensor) -> tuple[Tensor, ...]:
        frames = bone_frames(p)
        points = few_points(torch.float64, CPU)(p, None, frames)
        return (
            frames.hubs,
            frames.limbs,
            frames.torso,
            points.means,
            points.scales,
        )

    assert torch.autograd.gradcheck(
        values, (p,), fast_mode=True, eps=1e-8, atol=1e-4
    )
