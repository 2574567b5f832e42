"""Finger joints of the free body from hand landmarks: accuracy, limits, missing hands, damage."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from solved import shown
from torch import Tensor

from gsgan.body import axis_angle_to_matrix, free_body
from gsgan.body.fingers import Fingers
from gsgan.body.shape import STRETCHED, BodyShape, free_space, shape_body
from gsgan.body.solve import Solver, log_of
from gsgan.fit.shape import fit_hands
from gsgan.scene import BodyPose
from gsgan.skeleton.hands import FINGERS, HAND

LEFT, RIGHT = slice(33, 33 + HAND), slice(33 + HAND, 33 + 2 * HAND)
JOINTS = [
    i
    for i, name in enumerate(free_body().joint_names)
    if name.startswith("finger")
]


def degrees_off(got: Tensor, truth: Tensor) -> Tensor:
    """Between axis-angles ``[..., 3]``."""
    apart = axis_angle_to_matrix(got).mT @ axis_angle_to_matrix(truth)
    return log_of(apart).norm(dim=-1).rad2deg()


def test_fingers_of_exact_landmarks_are_the_true_ones(solver, poses):
    p, seen = shown(poses)
    pose = solver.solve(p, seen)
    off = degrees_off(pose.theta[:, JOINTS], poses.theta[:, JOINTS])
    assert off.median() < 3
    assert off.flatten().quantile(0.9) < 6
    body = free_body()
    hands = torch.isin(body.vertex_labels, torch.tensor([7, 8]))
    assert [body.label_names[i] for i in (7, 8)] == ["left_hand", "right_hand"]
    without = solver.solve(p[:, :33], seen[:, :33])
    away, before = (
        (body.posed_vertices(x) - body.posed_vertices(poses))[:, hands].norm(
            dim=-1
        )
        for x in (pose, without)
    )
    assert away.median() < 0.005
    assert away.median() < 0.4 * before.median()


def test_hands_move_no_more_of_the_body_than_the_arms(solver, poses):
    p, seen = shown(poses[:4])
    moved = r"(finger|wrist|lowerarm|upperarm|shoulder|clavicle).*"
    names = free_body().joint_names
    others = [
        i for i, name in enumerate(names) if not re.fullmatch(moved, name)
    ]
    without = solver.solve(p[:, :33], seen[:, :33])
    far = p.clone()
    far[:, LEFT] += 0.02
    wrist = names.index("wrist.L")
    moved = (solver.solve(p, seen).theta - solver.solve(far, seen).theta)[
        :, wrist
    ]
    assert moved.norm(dim=-1).min() > 0.02  # the arm follows
    for pose in (solver.solve(p, seen), solver.solve(far, seen)):
        assert (
            pose.theta[:, others] - without.theta[:, others]
        ).abs().max() < 0.02
        assert (pose.transl - without.transl).abs().max() < 0.002
    assert not without.theta[
        :, [j for j in JOINTS if "1-1" not in names[j]]
    ].any()


def test_a_hand_is_where_its_own_landmarks_are(solver, poses):
    """Even if the body's 33 put wrist and knuckles elsewhere, as other detectors do."""
    p, seen = shown(poses[:12])
    wrong = p.clone()
    wrong[:, [15, 17, 19, 21]] += torch.tensor([0.015, -0.01, 0.0])
    off, before = (
        (
            free_body().posed_hands(solver.solve(wrong[:, :n], seen[:, :n]))
            - p[:, 33:]
        ).norm(dim=-1)
        for n in (75, 33)
    )
    assert off.median() < 0.003
    assert off.max() < 0.02
    knuckles = [5, 9, 13, 17]
    assert before[:, knuckles].median() > 0.01
    assert off[:, knuckles].median() < 0.2 * before[:, knuckles].median()


def test_hands_that_close_and_spread(solver):
    """Both joints of every finger, about the line of the knuckles: no axis that the solver has."""
    body, random = free_body(), torch.Generator().manual_seed(0)
    theta = torch.zeros(40, 56, 3)
    for start, letter, side in ((0, "L", 1.0), (HAND, "R", -1.0)):
        wrist, index, pinky = (
            body.hand_landmarks[start + j] for j in (0, 5, 17)
        )
        knuckles = -side * torch.nn.functional.normalize(index - pinky, dim=0)
        out = torch.linalg.cross((index + pinky) / 2 - wrist, index - pinky)
        for finger in range(2, 6):
            bends = torch.rand(2, 40, 1, generator=random) * torch.tensor(
                [1.4, 1.8]
            ).view(2, 1, 1)
            apart = (
                0.15 * torch.randn(40, 1, generator=random) * out / out.norm()
            )
            for joint, turn in enumerate(
                (bends[0] * knuckles + apart, bends[1] * knuckles), 1
            ):
                theta[
                    :,
                    body.joint_names.index(f"finger{finger}-{joint}.{letter}"),
                ] = turn
    truth = BodyPose(theta, torch.zeros(40, 3))
    pose = solver.solve(*shown(truth))
    hands = torch.isin(body.vertex_labels, torch.tensor([7, 8]))
    away = (body.posed_vertices(pose) - body.posed_vertices(truth))[
        :, hands
    ].norm(dim=-1)
    assert away.median() < 0.003
    assert np.quantile(away.numpy(), 0.9) < 0.01


def test_a_persons_proportions_and_place_do_not_matter(poses):
    p, seen = shown(poses[:6])
    fingers = Fingers(free_body())
    expected = fingers(p[:, 33:], seen[:, 33:] > 0).turns
    R = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(3))
    )[0]
    moved = 1.3 * p[:, 33:] @ (R * torch.det(R)).mT + 2.0
    tip = moved.clone()
    for start in (0, HAND):  # longer last bones
        for *_, before, last in (tuple(start + j for j in f) for f in FINGERS):
            tip[:, last] += 0.5 * (tip[:, last] - tip[:, before])
    found = fingers(tip, seen[:, 33:] > 0).turns
    # longer bones place the hand elsewhere
    assert degrees_off(found, expected).max() < 0.5


def test_noise_stays_within_anatomical_limits(solver, poses):
    p, seen = shown(poses, 0.03)
    fingers = solver.fingers
    turns = fingers(p[:, 33:], seen[:, 33:] > 0).turns
    first, second = turns.unflatten(1, (2, 10)).unsqueeze(2).unbind(1)
    axes = fingers.axes.transpose(0, 1)  # [5, 10, 3], each number's
    numbers = torch.cat(
        [(axes[:3] * first).sum(-1), (axes[3:] * second).sum(-1)], dim=1
    ).mT
    assert (numbers >= fingers.minimum - 1e-3).all()
    assert (numbers <= fingers.maximum + 1e-3).all()
    assert ((fingers.maximum - fingers.minimum)[:, [0, 3]] < math.pi).all()
    hinges = [i for i in range(10) if i % 5]  # of the four fingers
    assert numbers[:, hinges, 4].abs().max() < 0.11


@pytest.mark.parametrize("how", ["visibility", "NaN"])
def test_a_missing_hand_rests_and_the_other_does_not_change(solver, poses, how):
    p, seen = shown(poses[:4])
    whole = solver.solve(p, seen).theta
    if how == "NaN":
        p[:, LEFT] = math.nan
    else:
        p[:, LEFT], seen[:, LEFT] = 0.0, 0.0
    theta, names = solver.solve(p, seen).theta, free_body().joint_names
    for joint in JOINTS:
        if names[joint].endswith("R"):
            assert torch.equal(theta[:, joint], whole[:, joint])
        elif (
            names[joint] != "finger1-1.L"
        ):  # the pose's own thumb landmark shows it
            assert not theta[:, joint].any()
    rest = solver.at_rest(p, seen)
    assert rest[:, names.index("finger3-2.L")].all()
    assert not rest[
        :, [names.index("finger3-2.R"), names.index("finger1-1.L")]
    ].any()


def test_a_finger_rests_from_the_first_joint_that_is_not_seen(solver, poses):
    p, seen = shown(poses[:4])
    names = free_body().joint_names
    truth = solver.solve(p, seen).theta
    p[:, 33 + 8] = math.nan  # the index's tip: its middle still shows the bend
    p[:, 33 + 9] = math.nan  # the middle finger's knuckle
    p[:, [33 + 15, 33 + 16]] = (
        math.nan
    )  # all beyond the ring finger's second joint
    theta = solver.solve(p, seen).theta
    index, ring = names.index("finger2-2.L"), names.index("finger4-1.L")
    torch.testing.assert_close(
        theta[:, index], truth[:, index], atol=0.01, rtol=0
    )
    assert not theta[
        :, [names.index("finger3-1.L"), names.index("finger3-2.L")]
    ].any()
    assert not theta[:, names.index("finger4-2.L")].any()
    torch.testing.assert_close(theta[:, ring], truth[:, ring], atol=0.1, rtol=0)


@pytest.mark.parametrize("kind", ["one point", "flat", "infinite", "folded"])
def test_damaged_hands_have_finite_fingers_and_gradients(solver, poses, kind):
    p, seen = shown(poses[:2])
    if kind == "one point":
        p[:, LEFT] = p[:, 15:16]
    elif kind == "flat":
        p[:, LEFT.start + 5 : LEFT.stop] = p[:, LEFT.start + 5 : LEFT.start + 6]
    elif kind == "infinite":
        p[0, LEFT.start], p[1, RIGHT.start + 7] = math.inf, -math.inf
    else:  # every finger back onto itself
        p[:, LEFT.start + 7] = p[:, LEFT.start + 5]
    p.requires_grad_()
    theta = solver.solve(p, seen).theta
    theta.square().sum().backward()
    assert theta.isfinite().all()
    assert p.grad.isfinite().all()


def test_gradients_are_those_of_finite_differences(poses):
    fingers = Fingers(free_body().to(torch.float64))
    p, seen = (x[:3] for x in shown(poses))
    hands, seen = p[:, 33:].double().requires_grad_(), seen[:, 33:] > 0
    goal = torch.randn(
        20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    (slope,) = torch.autograd.grad(
        (fingers(hands, seen)[0] * goal).sum(), hands
    )
    for joint, axis in ((0, 0), (6, 1), (8, 2), (HAND + 3, 0), (HAND + 17, 1)):
        step = torch.zeros_like(hands)
        step[:, joint, axis] = 1e-5
        with torch.no_grad():
            ahead, back = (fingers(hands + s * step, seen)[0] for s in (1, -1))
        found = ((ahead - back) * goal).sum() / 2e-5
        assert slope[:, joint, axis].sum() == pytest.approx(
            float(found), rel=1e-3, abs=1e-4
        )


def test_gradients_reach_landmarks_and_shape(poses):
    K = free_space().coefficients
    shape = BodyShape(
        torch.zeros(K, requires_grad=True), torch.ones(8, requires_grad=True)
    )
    p, seen = shown(poses[3:4])
    p.requires_grad_()
    theta = Solver(shape_body(shape)).solve(p, seen).theta
    others = [i for i in range(theta.shape[1]) if i not in JOINTS]
    of = shape.coefficients, shape.stretch, p
    for joints, shown_by in ((JOINTS, LEFT), (others, slice(33))):
        slopes = torch.autograd.grad(
            theta[:, joints].square().sum(), of, retain_graph=True
        )
        assert all(
            slope.abs().sum() > 0 for slope in (*slopes, slopes[2][:, shown_by])
        )


def test_a_mirrored_person_has_mirrored_fingers(poses):
    """The free body is symmetric: left and right exchanged give each other's angles."""
    fingers = Fingers(free_body())
    p, seen = shown(poses[:6])
    mirrored = (
        (p[:, 33:] * torch.tensor([-1.0, 1, 1])).unflatten(1, (2, HAND)).flip(1)
    )
    own = fingers(p[:, 33:], seen[:, 33:] > 0).turns
    other = fingers(mirrored.flatten(1, 2), seen[:, 33:] > 0).turns
    other = other.unflatten(1, (2, 2, 5)).flip(2).flatten(1, 3) * torch.tensor(
        [1.0, -1, -1]
    )
    assert degrees_off(own, other).median() < 2


def test_bodies_without_hand_landmarks_keep_their_fingers_at_rest(tmp_path):
    from writers.smpl import write_smpl

    from gsgan.body.smpl import read_smpl

    write_smpl(tmp_path / "model.npz", kind="smplx")
    body = read_smpl(tmp_path / "model.npz").as_body()
    p = body.posed_landmarks(BodyPose(torch.zeros(1, 55, 3), torch.zeros(1, 3)))
    p = torch.cat([p, torch.randn(1, 42, 3)], dim=1)
    theta = Solver(body).solve(p, p.isfinite().all(-1).float()).theta
    assert not theta[:, body.joint_names.index("left_index2")].any()


def test_a_person_whose_hands_are_larger_and_elsewhere_on_the_arms(poses):
    """Found by landmarks and forearms; then hands agree with 33 landmarks."""
    own, truth = free_space().neutral(), poses[:12]
    moves = torch.tensor(
        [[[0.01, -0.01, 0.0], [-0.01, 0.0, -0.015]]]
    ) * torch.tensor([[[1.0, 1, 1]], [[-1.0, 1, 1]]])
    stretch = torch.tensor([1.0] * 4 + [1.2] + [1.0] * 3)
    person = shape_body(
        replace(own, stretch=stretch, offsets=torch.zeros(33, 3), hands=moves)
    )
    p = torch.cat(
        [person.posed_landmarks(truth), person.posed_hands(truth)], dim=1
    )
    seen = torch.ones(p.shape[:2])
    seen[0, LEFT] = 0
    p[0, LEFT] = torch.nan
    shape = replace(own, offsets=torch.zeros(33, 3))
    found = fit_hands(shape, truth, p, seen)
    hand = STRETCHED.index("hand")
    np.testing.assert_allclose(found.stretch[hand], 1.2, atol=0.005)
    np.testing.assert_allclose(found.hands, moves, atol=0.006)
    assert fit_hands(shape, truth, p, 0 * seen).hands is None
    one = fit_hands(
        shape, truth, p, torch.cat([seen[:, :54], 0 * seen[:, RIGHT]], 1)
    ).hands
    np.testing.assert_allclose(one[0], moves[0], atol=0.006)
    assert not one[1].any()
    few = seen.clone()
    few[2:, [13, 15]] = 0  # without its forearm a hand shows no place on it
    rest = truth.theta.clone()
    rest[2:] = 0
    hidden = fit_hands(shape, BodyPose(rest, truth.transl), p, few).hands
    np.testing.assert_allclose(hidden[0], moves[0], atol=0.006)
    wild = p.clone()
    wild[:, LEFT] += 0.3
    assert not fit_hands(shape, truth, wild, seen).hands[0].any()
    solved = Solver(shape_body(found)).solve(p[1:], seen[1:])
    off = (shape_body(found).posed_hands(solved) - p[1:, 33:]).norm(dim=-1)
    assert off.median() < 0.003


def test_where_hands_are_on_the_arms_has_gradients(poses):
    hands = torch.zeros(2, 2, 3, requires_grad=True)
    shape = replace(
        free_space().neutral(), offsets=torch.zeros(33, 3), hands=hands
    )
    body = shape_body(shape)
    total = (
        body.posed_vertices(poses[:2]).sum() + body.posed_hands(poses[:2]).sum()
    )
    total.backward()
    assert hands.grad.isfinite().all()
    assert (hands.grad.abs() > 0).any(dim=-1).all()
