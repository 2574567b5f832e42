"""Linear blend skinning against closed forms."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsgan.body.free import free_body
from gsgan.body.lbs import (
    axis_angle_to_matrix,
    blend_transforms,
    forward_kinematics,
    kinematic_levels,
    skin,
    stretch_jacobian,
)
from gsgan.body.skinned import SkinnedBody, WeightGradients
from gsgan.scene import BodyPose

D = torch.float64


def rz(degrees: float) -> torch.Tensor:
    a = math.radians(degrees)
    c, s = math.cos(a), math.sin(a)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=D)


CHAIN = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], dtype=D)


@pytest.mark.parametrize(
    "angle", [0.0, 1e-9, 9.9e-4, 1.01e-3, 1.0, math.pi, 6.0]
)
def test_axis_angle_matches_matrix_exponential(angle):
    v = angle * torch.tensor([1.0, 2.0, -2.0], dtype=D) / 3
    K = torch.tensor(
        [[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]], dtype=D
    )
    torch.testing.assert_close(
        axis_angle_to_matrix(v), torch.linalg.matrix_exp(K), atol=1e-12, rtol=0
    )


def test_axis_angle_gradient_at_zero_is_the_cross_matrix():
    v = torch.zeros(3, dtype=D, requires_grad=True)
    J = torch.autograd.functional.jacobian(axis_angle_to_matrix, v)
    assert J[2, 1, 0] == 1
    assert J[1, 2, 0] == -1
    assert J[0, 0].abs().max() == 0


def test_rest_pose_is_the_identity():
    eye = torch.eye(3, dtype=D).expand(2, 3, 3, 3)
    T = forward_kinematics(CHAIN, (-1, 0, 1), eye, torch.zeros(2, 3, dtype=D))
    assert torch.equal(T, torch.eye(4, dtype=D).expand(2, 3, 4, 4))


def test_weights_are_renormalised():
    T = torch.eye(4, dtype=D).repeat(1, 2, 1, 1)
    T[0, 1, 0, 3] = 4
    _, t = blend_transforms(
        T, torch.tensor([[0, 1]]), torch.tensor([[30, 90]], dtype=torch.uint8)
    )
    assert t[0, 0, 0] == 3


def test_gradients_agree_with_finite_differences():
    index = torch.tensor([[0, 1], [1, 2], [2, 0]])
    weight = torch.tensor([[0.5, 0.5], [0.2, 0.8], [1.0, 0.0]], dtype=D)
    points = torch.tensor(
        [[0.5, 0.1, 0], [1.5, 0, 0.2], [2.5, 0.3, 0]], dtype=D
    )

    def posed(theta, transl):
        T = forward_kinematics(
            CHAIN, (-1, 0, 1), axis_angle_to_matrix(theta), transl
        )
        return skin(points, *blend_transforms(T, index, weight))

    generator = torch.Generator().manual_seed(0)
    theta = torch.randn(2, 3, 3, dtype=D, generator=generator)
    theta[0, 1] = 0
    transl = torch.randn(2, 3, dtype=D, generator=generator)
    assert torch.autograd.gradcheck(
        posed, (theta.requires_grad_(), transl.requires_grad_()), atol=1e-6
    )


@given(st.lists(st.floats(-6.3, 6.3), min_size=9, max_size=9), st.floats(0, 1))
def test_blends_never_stretch_and_slopes_are_finite(turns, share):
    """A mean of rotations has no singular value above 1."""
    theta = torch.tensor(turns, dtype=D).view(1, 3, 3).requires_grad_()
    joints = torch.tensor([[0.0, 0, 0], [0.3, 0, 0], [0.6, 0, 0]], dtype=D)
    bones = forward_kinematics(
        joints, (-1, 0, 1), axis_angle_to_matrix(theta), joints[:1]
    )
    pairs = torch.tensor([[0, 1], [1, 2], [0, 2], [2, 2]])
    weights = torch.tensor([share, 1 - share], dtype=D).expand(4, 2)
    A, t = blend_transforms(bones, pairs, weights)
    assert float(torch.linalg.svdvals(A.detach()).max()) <= 1 + 1e-9
    skin(
        torch.tensor([[0.7, 0.03, 0.02]], dtype=D).expand(4, 3), A, t
    ).square().sum().backward()
    assert theta.grad is not None
    assert theta.grad.isfinite().all()


def test_levels_put_parents_first():
    assert kinematic_levels((-1, 0, 0, 1, 3)) == [[0], [1, 2], [3], [4]]


@pytest.mark.parametrize(
    "wrong", [[0.0, 0.0], [1.5, -0.5], [math.nan, 1.0], [math.inf, 1.0]]
)
def test_a_body_refuses_vertices_without_weight_when_it_is_made(wrong):
    body = free_body()
    weight = body.bone_weight.float().clone()
    weight[7] = 0
    weight[7, :2] = torch.tensor(wrong)
    with pytest.raises(ValueError, match=r"bone_weight.* 1 vertices"):
        replace(body, bone_weight=weight)


@pytest.fixture
def bent_tube():
    """A tube along x, a hinge in its middle, weights that change smoothly over 0.4 m."""
    x, angle = torch.meshgrid(
        torch.linspace(0, 1, 81, dtype=D),
        torch.arange(24, dtype=D) * math.pi / 12,
        indexing="ij",
    )
    vertices = torch.stack(
        [x, 0.1 * angle.cos(), 0.1 * angle.sin()], dim=-1
    ).reshape(-1, 3)
    a = torch.arange(80 * 24)
    right = a // 24 * 24 + (a + 1) % 24
    faces = torch.cat(
        [
            torch.stack([a, right, a + 24], 1),
            torch.stack([right, right + 24, a + 24], 1),
        ]
    )
    share = ((vertices[:, 0] - 0.3) / 0.4).clamp(0, 1)
    share = share * share * (3 - 2 * share)
    return SkinnedBody(
        vertices=vertices,
        faces=faces.flip(1),
        joints=torch.tensor([[0.0, 0, 0], [0.5, 0, 0]], dtype=D),
        joint_names=("shoulder", "elbow"),
        parents=(-1, 0),
        bone_index=torch.tensor([[0, 1]]).expand(len(vertices), 2),
        bone_weight=torch.stack([1 - share, share], dim=1),
        vertex_labels=torch.zeros(len(vertices), dtype=torch.int64),
        label_names=("all",),
        label_source="own",
    )


def stretch_terms(body):
    chosen = torch.arange(len(body.vertices))
    return WeightGradients(body, chosen)(body.bone_index, body.bone_weight)


@pytest.mark.parametrize("turn", [0.0, 1.0, 2.8])
def test_the_jacobian_predicts_where_neighbours_go(bent_tube, turn):
    """Without the gradients of the weights the same prediction is several times as far off."""
    theta = torch.zeros(1, 2, 3, dtype=D)
    theta[0, 1, 2] = turn
    bones = bent_tube.transforms(
        BodyPose(theta=theta, transl=torch.zeros(1, 3, dtype=D))
    )
    A, t = blend_transforms(bones, bent_tube.bone_index, bent_tube.bone_weight)
    J = stretch_jacobian(
        A, bones, bent_tube.vertices, *stretch_terms(bent_tube)
    )
    posed = skin(bent_tube.vertices, A, t)[0]
    inner = torch.arange(24 * 30, 24 * 50)
    # 2.5 cm
    step = (
        bent_tube.vertices[inner + 48] - bent_tube.vertices[inner]
    ).unsqueeze(-1)
    moved = posed[inner + 48] - posed[inner]
    off, off_plain = (
        ((M[0, inner] @ step).squeeze(-1) - moved).norm(dim=-1).max()
        for M in (J, A)
    )
    assert off <= 0.005
    if turn == 0:
        torch.testing.assert_close(
            J[0], torch.eye(3, dtype=D).expand_as(J[0]), atol=1e-6, rtol=0
        )
    else:
        assert off < 0.4 * off_plain


@pytest.mark.parametrize("limit", [0.1, 0.3])
def test_the_stretch_has_a_limit(bent_tube, limit):
    theta = torch.zeros(1, 2, 3, dtype=D)
    theta[0, 1, 2] = 2.8
    bones = bent_tube.transforms(
        BodyPose(theta=theta, transl=torch.zeros(1, 3, dtype=D))
    )
    A, _ = blend_transforms(bones, bent_tube.bone_index, bent_tube.bone_weight)
    given = (A, bones, bent_tube.vertices, *stretch_terms(bent_tube))
    pulled = torch.linalg.matrix_norm(stretch_jacobian(*given) - A)
    limited = torch.linalg.matrix_norm(stretch_jacobian(*given, limit) - A)
    assert pulled.max() > 2 * limit
    torch.testing.assert_close(limited, pulled.clamp_max(limit))
    # A Gaussian is then longer by this share at most.
    longest = torch.linalg.matrix_norm(stretch_jacobian(*given, limit), ord=2)
    assert longest.max() <= 1 + limit + 1e-9


def test_all_bones_turned_alike_stretch_nothing_far_from_the_origin(bent_tube):
    bones = torch.eye(4).repeat(1, 2, 1, 1)
    bones[..., :3, :3] = rz(70).float()
    bones[..., :3, 3] = torch.tensor([500.0, -3.0, 1.0])
    A, _ = blend_transforms(bones, bent_tube.bone_index, bent_tube.bone_weight)
    J = stretch_jacobian(
        A, bones, bent_tube.vertices, *stretch_terms(bent_tube)
    )
    torch.testing.assert_close(
        J[0], rz(70).float().expand_as(J[0]), atol=1e-5, rtol=0
    )


def test_stretch_terms_of_degenerate_surfaces_are_finite(bent_tube):
    flat = replace(bent_tube, vertices=torch.zeros_like(bent_tube.vertices))
    loose = replace(
        bent_tube, faces=bent_tube.faces[:1]
    )  # most vertices have no edge
    for body in (flat, loose):
        assert stretch_terms(body)[1].isfinite().all()
