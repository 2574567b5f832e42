"""Ψ starts exactly at G, moves with the body, and stays finite where it saturates."""

import math
from dataclasses import replace

import pytest
import torch

from gsgan.model.deformation import Deformation
from gsgan.skeleton import MEDIAPIPE33, Densify, bone_frames
from gsgan.utils.errors import ConfigError

HEIGHT = 1.7


@pytest.fixture
def densify():
    return Densify(points_per_limb=5, face_points=200, torso_points=200)


def rest(batch: int = 1) -> torch.Tensor:
    return (
        torch.tensor(MEDIAPIPE33.rest_positions).expand(batch, -1, -1).clone()
    )


def small(densify: Densify, **options) -> Deformation:
    settings = {
        "width": 16,
        "layers": 2,
        "embedding": 4,
        "features": 2,
        "sh_degree": 0,
    } | options
    return Deformation(densify.rest_points, HEIGHT, **settings)


def run(psi: Deformation, densify: Densify, p: torch.Tensor, noise=None):
    valid = torch.ones(p.shape[:2], dtype=torch.bool)
    frames = bone_frames(p, valid)
    eye = torch.tensor([[0.0, 0.0, 4.0]]).expand(len(p), -1)
    return psi(p, densify(p, valid, frames), eye, noise)


def test_step_zero_is_exactly_the_initial_gaussians(densify):
    p = rest()
    points = densify(p)
    gaussians = run(small(densify, sh_degree=1), densify, p)
    torch.testing.assert_close(gaussians.means, points.means, rtol=0, atol=0)
    variances = torch.diagonal(gaussians.covariances, dim1=-2, dim2=-1)
    torch.testing.assert_close(
        variances, points.scales.square()[..., None].expand(-1, -1, 3)
    )
    torch.testing.assert_close(
        gaussians.opacities, torch.full_like(gaussians.opacities, 0.5)
    )
    torch.testing.assert_close(
        gaussians.features[..., :3], torch.full((1, densify.n_points, 3), 0.5)
    )
    assert (gaussians.features[..., 3:] == 0).all()


def test_billions_of_layers_are_refused(densify):
    with pytest.raises(ConfigError, match=r"layers.*2 .*1000"):
        small(densify, layers=2**31)


def test_invisible_parts_have_no_opacity(densify):
    p = rest()
    valid = torch.ones(1, 33, dtype=torch.bool)
    valid[0, 15] = False  # the left wrist
    frames = bone_frames(p, valid)
    points = densify(p, valid, frames)
    gaussians = small(densify)(p, points, torch.zeros(1, 3))
    assert (gaussians.opacities[~points.valid] == 0).all()
    assert (gaussians.opacities[points.valid] > 0).all()
    assert 0 < int((~points.valid).sum()) < densify.n_points


def test_psi_is_told_where_the_surface_looks_unless_it_shall_not_be(densify):
    torch.manual_seed(0)
    psi = small(densify, normals=True)
    with torch.no_grad():
        psi.head.weight.normal_(0, 0.3)
    points = densify(rest())
    turned = replace(points, normals=-points.normals)
    pose, root = torch.zeros(1, 99), torch.zeros(1, 3)
    told, other = (
        psi.residuals(given, pose, root).sh for given in (points, turned)
    )
    assert (told - other).abs().max() > 1e-3
    blind = small(densify)
    assert "from_normal.weight" not in blind.state_dict()
    blind.head.weight.data.copy_(psi.head.weight.data)
    one, two = (
        blind.residuals(given, pose, root).sh for given in (points, turned)
    )
    torch.testing.assert_close(one, two)


def test_noise_reaches_only_the_pose_code(densify):
    psi = small(densify)
    p = rest()
    noise = torch.randn(1, 33, 3)
    torch.testing.assert_close(
        run(psi, densify, p, noise).means, run(psi, densify, p).means
    )
    with torch.no_grad():
        psi.head.weight.normal_(0, 0.1)
    assert not torch.equal(
        run(psi, densify, p, noise).means, run(psi, densify, p).means
    )


def test_the_step_scales_offsets_up_to_the_same_bound(densify):
    slow, p = small(densify, mean_step=0.1), rest()
    at_rest = run(slow, densify, p).means
    for value, expected in ((1.0, 0.1), (1e4, 20.0)):
        slow.head.bias.data[:3] = value
        moved = (run(slow, densify, p).means - at_rest).norm(dim=-1)
        reach = 3**0.5 * slow.mean_bound * slow.stature * math.tanh(expected)
        torch.testing.assert_close(
            moved, torch.full_like(moved, reach), rtol=1e-4, atol=0
        )


def test_a_pose_far_from_training_counts_as_the_nearest_that_psi_learnt(
    densify,
):
    psi, p = small(densify, pose_limit=1.5), rest()
    psi.head.weight.data.normal_(0, 0.3)
    points = densify(p)
    axes = torch.linalg.qr(torch.randn(99, 4))[0]
    codes = (
        torch.randn(400, 4)
        @ torch.diag(torch.tensor([4.0, 3.0, 2.0, 1.0]))
        @ axes.T
    )

    def sh(code):
        return psi.residuals(points, code, torch.zeros(1, 3)).sh

    aside, within = torch.randn(1, 99), codes[:1] / 10
    aside = aside - aside @ axes @ axes.T
    raw = sh(within), sh(within + aside)
    psi.eval()
    # no poses are known
    torch.testing.assert_close((sh(within), sh(within + aside)), raw)
    means = points.means + torch.tensor([-0.1, 0.1])[:, None, None]
    psi.store_poses(codes, means, torch.zeros(2, 3))
    torch.testing.assert_close(
        (sh(within), sh(within + aside)), (raw[0], raw[0])
    )
    limits = [
        sh(codes.mean(0) + far * psi.pose_axes[:, :4].mT.sum(0)[None])
        for far in (9, 90)
    ]
    torch.testing.assert_close(*limits)
    assert (limits[1] - raw[0]).abs().max() > 0.1
    away = [replace(points, means=points.means + 9 * far) for far in (1, 10)]
    found = [psi.residuals(x, within, torch.zeros(1, 3)).sh for x in away]
    torch.testing.assert_close(*found)
    psi.train()
    torch.testing.assert_close((sh(within), sh(within + aside)), raw)
