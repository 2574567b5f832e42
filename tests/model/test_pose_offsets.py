"""Offsets that follow the bones: where they act, that they learn, and that copies keep them."""

from dataclasses import replace

import pytest
import torch
from configs import build_training

from gsgan.body import open_body
from gsgan.model.body_points import BodyPoints
from gsgan.model.deformation import Deformation
from gsgan.model.harmonic import distil
from gsgan.scene import BodyPose
from gsgan.utils.tensors import matvec

ON = "effects.body_points=on"


@pytest.fixture(scope="module")
def body():
    return open_body("free", None, ())


@pytest.fixture
def placed(body):
    torch.manual_seed(0)
    placed = BodyPoints(
        body, 1.7, points=600, controls=100, pose_offsets=0.01
    ).eval()
    torch.nn.init.normal_(placed.offsets.field)
    return placed


def posed(body, joint: str | None = None, turn: float = 1.0) -> BodyPose:
    theta = torch.zeros(1, len(body.joints), 3)
    if joint is not None:
        theta[0, body.joint_names.index(joint), 0] = turn
    return BodyPose(theta, torch.zeros(1, 3))


def test_nothing_moves_at_rest_or_with_the_whole_body(body, placed):
    assert torch.equal(
        placed.offset(posed(body)), torch.zeros(1, placed.n_points, 3)
    )


def test_a_knee_moves_no_point_above_the_hips(body, placed):
    with torch.no_grad():
        offset = placed.offset(posed(body, "lowerleg01.L")).norm(dim=-1)[0]
    height = placed.points.means[:, 2]
    hips = body.joints[body.joint_names.index("upperleg01.L"), 2]
    knee = body.joints[body.joint_names.index("lowerleg01.L")]
    near = (placed.points.means - knee).norm(dim=1) < 0.15
    assert offset[near].median() > 0.005
    assert offset[height > hips + 0.2].max() == 0


def test_the_offset_turns_with_the_body(body, placed):
    pose = posed(body, "upperleg01.L")
    turned = replace(pose, theta=pose.theta.clone())
    turned.theta[:, 0] = torch.tensor([0.0, 0.0, 1.3])
    with torch.no_grad():
        a, b = placed.offset(pose), placed.offset(turned)
        torch.testing.assert_close(a, b)
        points = placed(pose)
        plain = BodyPoints(body, 1.7, points=600, controls=100).eval()(pose)
    torch.testing.assert_close(
        points.means, plain.means + matvec(points.frames, a), atol=1e-5, rtol=0
    )


def test_offsets_learn_and_only_where_bones_turn(body, placed):
    placed.train()
    placed(posed(body, "lowerleg01.L")).means.square().sum().backward()
    slope = placed.offsets.field.grad
    assert slope.isfinite().all()
    follows = (
        placed.offsets.bones == body.joint_names.index("lowerleg01.L")
    ).any(1)
    assert (slope.flatten(1).abs().sum(1) > 0)[follows].any()
    assert not slope[~follows].any()


def test_constant_offsets_are_those_at_rest(body, placed):
    placed.offsets.start(
        torch.full_like(placed.offsets.rest, 0.02), placed.offsets.field
    )
    found = placed.offset(posed(body))
    torch.testing.assert_close(found, torch.full_like(found, 0.02))


@pytest.mark.parametrize("bound", [0.25, None])
def test_residuals_with_an_offset_move_the_means_by_it(bound):
    psi = Deformation(
        torch.randn(9, 3), 1.7, width=8, layers=2, mean_bound=bound
    )
    means, offset = 0.1 * torch.randn(1, 9, 3), 0.02 * torch.randn(1, 9, 3)

    def metres(residual):
        share = residual if bound is None else bound * torch.tanh(residual)
        return 1.7 * share

    torch.testing.assert_close(
        metres(psi.with_offset(means, offset)),
        metres(means) + offset,
        atol=1e-5,
        rtol=0,
    )


def test_a_page_gets_the_offsets_as_residuals(tiny):
    """Over one pose the fit is exact, so Gaussians stay where they are."""
    data, module = build_training(
        tiny("model=splat_only", ON, "model.body_points.pose_offsets=0.01")
    )
    avatar = module.avatar.eval()
    torch.nn.init.normal_(avatar.body_points.offsets.field)
    frame = data.dataset("train")[0]
    body = avatar.body_pose(frame.skeleton, frame.visibility)
    pose = (frame.skeleton, frame.visibility, body)
    found = distil(avatar, [pose], ridge=1e-12, keep_offsets=False)
    assert found.body_points.offsets is None
    assert avatar.body_points.offsets is not None
    eye = frame.camera.centre
    with torch.no_grad():
        images = []
        for one in (avatar, found):
            points, residuals = one.residuals(
                frame.skeleton, frame.visibility > 0, body
            )
            images.append(one.deformation.compose(points, residuals, eye).means)
    torch.testing.assert_close(*images, atol=2e-3, rtol=0)
