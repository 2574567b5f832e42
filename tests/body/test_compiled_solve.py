"""The compiled solve against the one by tensor operations, which defines it."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from solved import damaged, shown
from torch import Tensor
from writers.smpl import write_smpl

from gsgan.body import compiled, free_body
from gsgan.body.skinned import MarkedBody
from gsgan.body.smpl import read_smpl
from gsgan.body.solve import Solver
from gsgan.scene import BodyPose
from gsgan.splat import native
from gsgan.synthetic.free_subject import free_character, free_pose
from gsgan.synthetic.recorded_motion import RecordedMotion

pytestmark = pytest.mark.skipif(not native.available(), reason=native.why_not())
RUN = Path(__file__).parents[1] / "motion" / "files" / "02_03.amc"
SAME = 1e-4  # metres, the surface's: float32 against float64


@pytest.fixture
def both(monkeypatch):
    """Poses by compiled code and by tensor operations."""

    def solved(
        solver: Solver, p: Tensor, seen: Tensor
    ) -> tuple[BodyPose, BodyPose]:
        fast = solver.solve(p, seen)
        with monkeypatch.context() as patch:
            patch.setattr(compiled, "available", lambda _: False)
            return fast, solver.solve(p, seen)

    return solved


def apart(
    pair: tuple[BodyPose, BodyPose], body: MarkedBody | None = None
) -> Tensor:
    """``[B, V]`` metres between the surfaces of two solutions."""
    a, b = ((body or free_body()).posed_vertices(pose) for pose in pair)
    return (a - b).norm(dim=-1)


@pytest.mark.parametrize("joints", [33, 75])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_choreography_has_the_same_poses(solver, poses, both, joints, noise):
    p, seen = (x[:, :joints] for x in shown(poses, noise))
    assert apart(both(solver, p, seen)).max() < SAME


def test_motion_capture_has_the_same_poses(solver, both):
    motion = RecordedMotion(free_character(), RUN)
    frames = motion.at(np.linspace(0, motion.duration, 15))
    p, seen = shown(free_pose(frames))
    assert apart(both(solver, p, seen)).max() < SAME


@pytest.mark.parametrize("joints", [33, 75])
def test_hidden_landmarks_give_the_same_poses(solver, poses, both, joints):
    """A third of all but the trunk's. A limb of which only the end is seen has two solutions."""
    p, seen = (x[:, :joints].clone() for x in shown(poses, 0.005))
    lost = (
        torch.rand(seen.shape, generator=torch.Generator().manual_seed(4)) < 0.3
    )
    lost[:, [11, 12, 23, 24]] = False
    seen[lost], p[lost] = 0, math.nan
    off = apart(both(solver, p, seen))
    assert off.median() < SAME / 10
    assert off.median(dim=1).values.max() < SAME


def test_landmarks_that_are_seen_weakly_weigh_the_same(solver, poses, both):
    p, seen = shown(poses, 0.02)
    seen = (
        torch.rand(seen.shape, generator=torch.Generator().manual_seed(4)) * 1.5
        + 0.01
    )
    assert apart(both(solver, p, seen)).max() < SAME


ALIKE = (
    "straight legs",
    "no arm",
    "NaN",
    "NaN visibility",
    "infinite",
    "only the trunk",
)
ALIKE = (
    *ALIKE,
    "estimated hips",
    "lost fingers",
    "lying on the side",
    "upside down",
)


@pytest.mark.parametrize("kind", ALIKE)
def test_damaged_skeletons_have_the_same_poses(solver, both, kind):
    assert apart(both(solver, *damaged(kind))).max() < SAME


@pytest.mark.parametrize(
    "kind", ["one point", "folded limbs", "far", "hands of one point"]
)
def test_skeletons_without_one_answer_have_finite_poses(solver, kind):
    """Half turns about any axis, or coordinates that float32 rounds to millimetres."""
    pose = solver.solve(*damaged(kind))
    assert pose.theta.isfinite().all()
    assert pose.transl.isfinite().all()


def test_a_frame_is_the_same_to_the_bit_in_any_batch_and_with_any_threads(
    solver, poses
):
    p, seen = shown(poses, 0.01)
    together = solver.solve(p, seen)
    try:
        torch.set_num_threads(2)
        assert torch.equal(solver.solve(p, seen).theta, together.theta)
    finally:
        torch.set_num_threads(1)
    for i in (0, 7, len(p) - 1):
        alone = solver.solve(p[i : i + 1], seen[i : i + 1])
        assert torch.equal(alone.theta[0], together.theta[i])
        assert torch.equal(alone.transl[0], together.transl[i])


def test_no_frames(solver):
    assert solver.solve(
        torch.zeros(0, 75, 3), torch.zeros(0, 75)
    ).theta.shape == (
        0,
        56,
        3,
    )


@pytest.mark.parametrize("kind", ["smpl", "smplx"])
def test_bodies_of_the_users_files_have_the_same_poses(tmp_path, both, kind):
    """They lack landmarks of the mouth, and hands."""
    write_smpl(tmp_path / "model.npz", kind=kind)
    body = read_smpl(tmp_path / "model.npz").as_body()
    theta = 0.1 * torch.randn(
        4, len(body.parents), 3, generator=torch.Generator().manual_seed(2)
    )
    p = body.posed_landmarks(BodyPose(theta, torch.ones(4, 3)))
    pair = both(Solver(body), p, p.isfinite().all(-1).float())
    assert apart(pair, body).max() < SAME


def test_double_precision_stays(poses, both):
    p, seen = (x[:3].double() for x in shown(poses))
    fast, slow = both(Solver(free_body().to(torch.float64)), p, seen)
    torch.testing.assert_close(fast.theta, slow.theta, atol=1e-9, rtol=0)
    torch.testing.assert_close(fast.transl, slow.transl, atol=1e-9, rtol=0)


def test_poses_with_gradients_are_solved_by_tensor_operations(
    solver, poses, monkeypatch
):
    monkeypatch.setattr(compiled, "solve", None)
    p, seen = shown(poses[:1])
    assert solver.solve(p.requires_grad_(), seen).theta.requires_grad
    with torch.no_grad(), pytest.raises(TypeError):
        solver.solve(p, seen)
