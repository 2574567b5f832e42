"""From skeletons to poses of the free body and of SMPL's: accuracy, hinges, damage."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import solved
import torch
from solved import damaged
from torch import Tensor
from writers.smpl import write_smpl

from gsgan.body import free_body, solve
from gsgan.body.rig import HINGE_MINIMA, TRUNK, build_rig, trunk_covariance
from gsgan.body.smpl import read_smpl
from gsgan.body.solve import Solver
from gsgan.scene import BodyPose
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.sides import refuse_swapped

SEEN = torch.ones(1, 33)
shown = partial(solved.shown, joints=33)


def surface_error(got: BodyPose, truth: BodyPose) -> Tensor:
    """``[B, V]`` metres."""
    body = free_body()
    return (body.posed_vertices(got) - body.posed_vertices(truth)).norm(dim=-1)


@pytest.mark.parametrize(
    ("noise", "median", "maximum"), [(0.0, 0.0045, 0.015), (0.01, 0.012, 0.03)]
)
def test_the_solved_surface_is_near_the_true_one(
    solver, poses, noise, median, maximum
):
    off = surface_error(solver.solve(*shown(poses, noise)), poses)
    assert off.median() < median
    assert np.quantile(off.numpy(), 0.9) < maximum


def test_a_frame_does_not_depend_on_the_others_and_repeats_to_the_bit(
    solver, poses
):
    p, seen = shown(poses[:5], 0.01)
    together = solver.solve(p, seen)
    assert torch.equal(together.theta, solver.solve(p, seen).theta)
    alone = solver.solve(p[2:3], seen[2:3])
    torch.testing.assert_close(
        alone.theta, together.theta[2:3], atol=1e-3, rtol=0
    )


def test_a_pose_moves_and_turns_with_the_skeleton(solver, poses):
    p, seen = shown(poses[:4])
    R = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(3))
    )[0]
    R = R * torch.det(R)
    far = p @ R.mT + torch.tensor([40.0, -7.0, 3.0])
    moved, here = solver.solve(far, seen), solver.solve(p, seen)
    body = free_body()
    expected = body.posed_landmarks(here) @ R.mT + torch.tensor(
        [40.0, -7.0, 3.0]
    )
    torch.testing.assert_close(
        body.posed_landmarks(moved), expected, atol=2e-3, rtol=0
    )


def test_knees_and_elbows_are_hinges_and_ankles_hardly_turn(solver, poses):
    """Of skeletons with 3 cm of noise: where the numbers across a hinge would wander."""
    theta = solver.solve(*shown(poses, 0.03)).theta
    names = free_body().joint_names
    rig = build_rig(free_body())
    for name, joint in (("knee", "lowerleg01.{}"), ("elbow", "lowerarm01.{}")):
        for side, letter in (("left", "L"), ("right", "R")):
            number = rig.names.index(f"{side}_{name}")
            axis = rig.entry_axis[rig.entry_number == number][0]
            turn = theta[:, names.index(joint.format(letter))]
            assert (turn @ axis).min() > HINGE_MINIMA[name] - 0.25
            if name == "knee":
                assert (turn - (turn @ axis).unsqueeze(1) * axis).norm(
                    dim=-1
                ).median() < 0.1
    yaw = torch.stack([theta[:, names.index(f"foot.{s}")][:, 2] for s in "LR"])
    assert yaw.abs().median() < 0.15


def test_twist_spreads_along_the_forearm_and_the_upper_arm(solver):
    """A turned palm with a bent elbow: the wrist does not turn alone."""
    body, names = free_body(), free_body().joint_names
    truth = BodyPose(torch.zeros(1, 56, 3), torch.zeros(1, 3))
    along = (
        body.joints[names.index("wrist.L")]
        - body.joints[names.index("lowerarm01.L")]
    )
    truth.theta[0, names.index("lowerarm02.L")] = 1.0 * along / along.norm()
    theta = solver.solve(*shown(truth)).theta[0]
    turns = [
        float(theta[names.index(j)] @ along / along.norm())
        for j in ("lowerarm01.L", "lowerarm02.L", "wrist.L")
    ]
    assert min(turns) > 0.05
    assert sum(turns) == pytest.approx(1.0, abs=0.15)


# Two frames of CMU's clip 01_14, a climb: degrees of the numbers `TRUNK`.
CLIMB = (
    (41, -1, 2, 6, 2, 6, -14, 2, 5, -15, 2, 19, -3),
    (15, 6, 1, 2, 9, 3, -6, 4, 1, -4, -14, 1, 16),
)


def test_the_trunk_bends_as_people_bend_it(solver):
    """With one even bend of the spine: RMS 17 and 12 mm, the pelvis 49 and 19 degrees off."""
    body, theta = free_body(), torch.zeros(2, 56, 3)
    rig, degrees = build_rig(body), torch.tensor(CLIMB).float().deg2rad()
    for name, value in zip(TRUNK, degrees.mT, strict=True):
        [entry] = (rig.entry_number == rig.names.index(name)).nonzero()[0]
        joint = rig.joint[rig.entry_turn[entry]]
        theta[:, joint] += value.unsqueeze(1) * rig.entry_axis[entry]
    truth = BodyPose(theta, torch.zeros(2, 3))
    got = solver.solve(*shown(truth))
    main = body.bone_index.gather(
        1, body.bone_weight.argmax(1, keepdim=True)
    ).squeeze(1)
    spine = [i for i, n in enumerate(body.joint_names) if n.startswith("spine")]
    off = surface_error(got, truth)[
        :, torch.isin(main, torch.tensor([0, *spine]))
    ]
    assert off.square().mean(1).sqrt().max() < 0.013
    assert got.theta[:, 0].norm(dim=-1).rad2deg().max() < 25


def test_the_learnt_covariance_is_a_covariance_and_symmetrical():
    covariance = trunk_covariance()
    assert torch.linalg.eigvalsh(covariance).min() > math.radians(2) ** 2
    swapped = [*range(9), 11, 12, 9, 10]
    signs = torch.tensor([1, -1, -1] * 3 + [-1] * 4).double()
    mirrored = (covariance * signs * signs[:, None])[swapped][:, swapped]
    torch.testing.assert_close(mirrored, covariance, atol=1e-5, rtol=0)


# -- gradients


def test_gradients_are_those_of_the_solution(monkeypatch, poses):
    """In float64, against finite differences; Gauss-Newton's matrix leaves a few percent."""
    monkeypatch.setattr(solve, "MIN_IMPROVEMENT", 1e-9)
    monkeypatch.setattr(solve, "MAX_STEPS", 30)
    fine = Solver(free_body().to(torch.float64))
    p, seen = (x[:1].double() for x in shown(poses[3:4]))
    p = p.clone().requires_grad_()
    goal = torch.randn(
        1, 56, 3, generator=torch.Generator().manual_seed(1), dtype=p.dtype
    )
    (slope,) = torch.autograd.grad((fine.solve(p, seen).theta * goal).sum(), p)
    for joint, axis in ((15, 0), (25, 1), (11, 2)):
        step = torch.zeros_like(p)
        step[0, joint, axis] = 1e-3
        with torch.no_grad():
            ahead, back = (
                fine.solve(p + s * step, seen).theta for s in (1, -1)
            )
        found = ((ahead - back) * goal).sum() / 2e-3
        assert slope[0, joint, axis] == pytest.approx(
            float(found), rel=0.1, abs=0.1
        )


# -- damage


KINDS = (
    "straight legs",
    "one point",
    "no arm",
    "NaN",
    "infinite",
    "folded limbs",
    "far",
)


@pytest.mark.parametrize("kind", [*KINDS, "only the trunk"])
def test_damaged_skeletons_have_finite_poses_and_gradients(solver, kind):
    p, seen = (x[:, :33] for x in damaged(kind))
    p.requires_grad_()
    pose = solver.solve(p, seen)
    (pose.theta.sum() + pose.transl.sum()).backward()
    assert pose.theta.isfinite().all()
    assert pose.transl.isfinite().all()
    assert p.grad.isfinite().all()


def test_limbs_that_are_not_seen_stay_at_rest_and_are_marked(solver, poses):
    p, seen = shown(poses[:3])
    seen[:, [13, 15, 17, 19, 21]] = 0
    p[:, [26, 28, 30, 32]] = math.nan
    theta = solver.solve(p, seen).theta
    rest, names = solver.at_rest(p, seen), free_body().joint_names
    assert rest.shape == (3, 56)
    for name in (
        "upperarm01.L",
        "lowerarm01.L",
        "wrist.L",
        "lowerleg01.R",
        "foot.R",
    ):
        joint = names.index(name)
        assert theta[:, joint].abs().max() < 1e-5
        assert rest[:, joint].all(), name
    moved = [
        names.index(n)
        for n in ("root", "spine05", "upperarm01.R", "lowerleg01.L", "head")
    ]
    assert not rest[:, moved].any()
    elsewhere = surface_error(
        BodyPose(theta, solver.solve(p, seen).transl), poses[:3]
    )
    whole = free_body().vertex_labels == free_body().label_names.index(
        "left_leg"
    )
    assert elsewhere[:, whole].median() < 0.01


def test_a_trunk_without_hips_does_not_nod_with_the_head(solver):
    """Hips are estimates 3 cm off; legs stay at rest and are marked."""
    theta = torch.zeros(1, len(free_body().parents), 3)
    theta[:, free_body().joint_names.index("head")] = torch.tensor(
        [0.5, 0.0, 0.0]
    )
    p, _ = shown(BodyPose(theta, torch.zeros(1, 3)))
    truth, seen = p.clone(), SEEN.clone()
    p[:, 23:25] += 0.02
    p[:, 25:], seen[:, 23:] = torch.nan, 0
    found = solver.solve(p, seen)
    off = (free_body().posed_landmarks(found) - truth).norm(dim=-1)
    assert off[0, 11:17].max() < 0.01
    assert off[0, 23:25].max() < 0.05
    rested = solver.at_rest(p, seen)[0]
    assert rested[free_body().joint_names.index("upperleg01.L")]
    assert found.theta[0, rested].abs().max() < 0.02


def test_too_few_trunk_joints_are_refused_by_name(solver, poses):
    p, seen = shown(poses[:2])
    seen[1, [11, 12]] = 0
    with pytest.raises(
        ValueError, match="item 1: left_shoulder, right_shoulder"
    ):
        solver.solve(p, seen)
    with pytest.raises(ValueError, match=r"33, 75, 105 .*20"):
        solver.solve(p[:, :20], seen[:, :20])


@pytest.mark.parametrize("kind", ["names", "mirrored", "shoulders"])
def test_swapped_sides_are_refused_by_name(solver, poses, kind):
    p, seen = shown(poses[:8])
    if kind == "names":
        p = p[:, list(MEDIAPIPE33.mirror)]
    elif kind == "mirrored":
        p = p * torch.tensor([-1.0, 1.0, 1.0])
    else:
        p[:, [11, 12]] = p[:, [12, 11]]
    where = (
        "shoulders" if kind == "shoulders" else "hips, shoulders, ears, eyes"
    )
    with pytest.raises(
        ValueError,
        match=f"left .* right .*{where}",
    ):
        refuse_swapped(p, seen > 0)
    refuse_swapped(
        p[3:4], seen[3:4] > 0
    )  # a single frame may be an extreme pose
    assert solver.solve(p[3:4], seen[3:4]).theta.isfinite().all()


# -- SMPL


@pytest.mark.parametrize("kind", ["smpl", "smplx"])
def test_bodies_of_the_users_files_follow_their_landmarks(tmp_path, kind):
    write_smpl(tmp_path / "model.npz", kind=kind)
    body = read_smpl(tmp_path / "model.npz").as_body()
    names, random = body.joint_names, torch.Generator().manual_seed(2)
    theta = torch.zeros(6, len(names), 3)
    theta[:, 0] = torch.randn(6, 3, generator=random)
    for joint in (
        "left_shoulder",
        "right_shoulder",
        "left_hip",
        "spine2",
        "neck",
        "left_collar",
    ):
        theta[:, names.index(joint)] = 0.15 * torch.randn(
            6, 3, generator=random
        )
    truth = BodyPose(theta, torch.randn(6, 3, generator=random))
    p = body.posed_landmarks(truth)
    known = p.isfinite().all(-1)
    assert known[0].tolist() == [
        n not in ("mouth_left", "mouth_right") for n in MEDIAPIPE33.names
    ]
    pose = Solver(body).solve(p, known.float())
    off = (body.posed_landmarks(pose) - p).norm(dim=-1)[known]
    assert off.median() < 0.003
    surface = (body.posed_vertices(pose) - body.posed_vertices(truth)).norm(
        dim=-1
    )
    assert surface.median() < 0.02


def test_a_body_of_unknown_joints_is_refused():
    body = free_body()
    named = replace(body, joint_names=tuple(f"bone{i}" for i in range(56)))
    with pytest.raises(ValueError, match="bone0, bone1, bone2"):
        Solver(named)
