"""Projection: closed forms, extents, quaternions."""

import math
from dataclasses import replace

import pytest
import torch
from splat_scenes import camera, cloud, one

from gsgan.splat import ACCURACY, project
from gsgan.splat.project import rotations

EXACT, HIGH, STANDARD = (
    ACCURACY[name] for name in ("exact", "high", "standard")
)


def covariance(projected):
    """The 2D covariance of each ellipse, from its factors."""
    p, k, r = projected.factors.unbind(-1)
    factor = torch.stack([p, p * k, 0 * r, r], -1).unflatten(-1, (2, 2))
    return torch.linalg.inv(factor.mT @ factor)


def test_mean_and_covariance_of_a_gaussian_on_the_axis():
    gaussians = one((0.0, 0.0, 2.0), scale=(0.1, 0.2, 0.3))
    p = project(gaussians, camera((24, 32), focal=30.0), EXACT)
    torch.testing.assert_close(
        p.means[0, 0], torch.tensor([16.0, 12.0]).double()
    )
    want = torch.diag(torch.tensor([1.5**2 + 0.3, 3.0**2 + 0.3])).double()
    torch.testing.assert_close(covariance(p)[0, 0], want)
    assert p.depths.item() == 2.0


def test_off_axis_depth_extent_shears_the_ellipse():
    # A line along z at x/z = 0.25 moves the image by -f x/z² per metre of depth.
    gaussians = one((0.5, 0.0, 2.0), scale=(1e-9, 1e-9, 0.1))
    p = project(gaussians, camera(focal=30.0), EXACT)
    along_x = 30.0 * 0.5 / 4 * 0.1
    assert covariance(p)[0, 0, 0, 0].item() == pytest.approx(along_x**2 + 0.3)
    assert covariance(p)[0, 0, 1, 1].item() == pytest.approx(0.3)


def test_jacobian_is_clamped_off_axis():
    # Half the field of view is tan = 16/30; beyond 1.3 of it the shear stops growing.
    cam = camera((24, 32), focal=30.0)
    gaussians = one((20.0, 0.0, 2.0), scale=(1e-9, 1e-9, 0.1))
    p = project(gaussians, cam, EXACT)
    along_x = 30.0 / 2 * (1.3 * 16 / 30) * 0.1
    assert covariance(p)[0, 0, 0, 0].item() == pytest.approx(along_x**2 + 0.3)
    assert p.means[0, 0, 0].item() == pytest.approx(16 + 30 * 10)


def test_clamp_follows_an_off_centre_principal_point():
    cam = camera((24, 32), focal=30.0)
    K = cam.K.clone()
    K[:, 0, 2] = 0.0  # x/z from 0 to 32/30: the middle is 16/30
    gaussians = one((20.0, 0.0, 2.0), scale=(1e-9, 1e-9, 0.1))
    p = project(gaussians, replace(cam, K=K), EXACT)
    along_x = 30.0 / 2 * (16 / 30 + 1.3 * 16 / 30) * 0.1
    assert covariance(p)[0, 0, 0, 0].item() == pytest.approx(along_x**2 + 0.3)


def test_singular_covariances_are_drawn():
    flat = torch.zeros(1, 3, 3, 3).double()
    gaussians = replace(cloud(3), quats=None, scales=None, covariances=flat)
    p = project(gaussians, camera(), EXACT)
    torch.testing.assert_close(covariance(p)[0, 0], 0.3 * torch.eye(2).double())


def test_opacity_aware_extent_is_the_box_of_the_ellipse():
    gaussians = one(
        scale=(0.1, 0.2, 0.3), quat=(0.9, 0.1, 0.2, 0.3), opacity=0.7
    )
    p = project(gaussians, camera((200, 200)), STANDARD)
    level = 2 * math.log(0.7 * 255)
    want = (level * covariance(p)[0, 0].diagonal()).sqrt()
    torch.testing.assert_close(
        p.extents[0, 0].double(), want, rtol=3e-3, atol=0
    )
    # rounded up: it may not lose a pixel
    assert (p.extents[0, 0].double() >= want).all()


def test_extents_by_setting():
    gaussians = one(scale=(0.1, 0.1, 0.1), opacity=0.5)
    sigma = math.sqrt(1.5**2 + 0.3)
    sizes = {
        n: project(gaussians, camera(), s).extents[0, 0, 0].item()
        for n, s in ACCURACY.items()
    }
    assert sizes["draft"] == pytest.approx(3 * sigma, rel=1e-6)
    assert sizes["standard"] == pytest.approx(
        math.sqrt(2 * math.log(127.5)) * sigma, rel=3e-3
    )
    assert math.exp(-0.5 * (sizes["exact"] / sigma) ** 2) == 0.0


@pytest.mark.parametrize(
    ("opacity", "visible"),
    [(1 / 256, False), (1 / 254, True), (0.0, False), (1.0, True)],
)
def test_an_opacity_below_alpha_min_has_no_extent(opacity, visible):
    p = project(one((1 / 30, 1 / 30, 2.0), opacity=opacity), camera(), STANDARD)
    assert p.visible.item() is visible
    assert bool(p.extents.any()) is visible


@pytest.mark.parametrize(
    ("x", "visible"), [(0.0, True), (1.2, True), (1.8, False), (-1.8, False)]
)
def test_visible_where_the_footprint_overlaps_the_image(x, visible):
    # Half the image is 16 px at 15 px/m: 1.067 m; the footprint of 0.1 m reaches 5.1 px.
    assert (
        project(one((x, 0.0, 2.0)), camera(), STANDARD).visible.item()
        is visible
    )


def test_extents_and_visibility_have_no_gradient():
    gaussians = cloud(5)
    p = project(
        replace(gaussians, means=gaussians.means.requires_grad_()),
        camera(),
        HIGH,
    )
    assert p.means.requires_grad
    assert not p.extents.requires_grad
    assert not p.visible.requires_grad


def test_rotations_are_rotations():
    half = math.radians(35)
    quat = torch.tensor([math.cos(half), 0, 0, math.sin(half)]).double()
    c, s = math.cos(2 * half), math.sin(2 * half)
    want = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]]).double()
    torch.testing.assert_close(rotations(quat), want)
    R = rotations(cloud(20).quats)
    eye = torch.eye(3).double().expand_as(R)
    torch.testing.assert_close(R @ R.mT, eye)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(1, 20).double())
