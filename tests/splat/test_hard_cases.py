"""Every backend on hard inputs: degenerate, opaque, coincident, hidden or far away."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from splat_scenes import (
    CUT,
    DENSE,
    assert_like_reference,
    camera,
    cloud,
    draw,
    error,
    every_backend,
    fast_backend,
    join,
    leaves,
    loss,
    one,
)

from gsgan.scene import Gaussians
from gsgan.splat import ACCURACY, rasterise


@every_backend
@pytest.mark.parametrize("settings", ["exact", "high"])
def test_no_gaussians_give_zeros_with_a_graph(backend, settings):
    gaussians = leaves(cloud(0, 5, batch=2))
    cam = leaves(camera((3, 4), batch=2))
    raster = rasterise(gaussians, cam, settings=settings, backend=backend, depth=True)
    assert raster.features.shape == (2, 5, 3, 4)
    assert raster.alpha.shape == raster.depth.shape == (2, 1, 3, 4)
    assert not raster.features.any()
    assert not raster.alpha.any()
    loss(raster).backward()
    assert gaussians.means.grad.shape == (2, 0, 3)
    assert not cam.t.grad.any()


UNSEEN = {
    "behind": (0.0, 0.0, -2.0),
    "at z = 0": (0.3, 0.2, 0.0),
    "on the near plane": (0.0, 0.0, 0.01),
    "far off-axis": (1e6, 0.0, 1.0),
    "beside the image": (-9.0, 0.0, 2.0),
}


@every_backend
@pytest.mark.parametrize("settings", ["exact", "high"])
@pytest.mark.parametrize("where", list(UNSEEN))
def test_unseen_gaussians_have_no_effect(backend, settings, where):
    hidden = one(UNSEEN[where], features=(1.0, 1.0, 1.0), scale=(0.01,) * 3)
    alone, alone_grads = draw(cloud(10), camera(), settings, backend)
    both, both_grads = draw(join(hidden, cloud(10)), camera(), settings, backend)
    torch.testing.assert_close(both.features, alone.features, rtol=0, atol=1e-12)
    for name in ("means", "quats", "scales", "opacities", "features"):
        assert not both_grads[name][:, :1].any(), name
        torch.testing.assert_close(both_grads[name][:, 1:], alone_grads[name], rtol=1e-6, atol=1e-9)
    for name in ("K", "R", "t"):
        torch.testing.assert_close(both_grads[name], alone_grads[name], rtol=1e-6, atol=1e-9)


@every_backend
def test_none_visible(backend):
    gaussians = replace(cloud(10), means=-cloud(10).means)
    raster, grads = draw(gaussians, camera(), "high", backend)
    assert not raster.features.any()
    assert not any(grad.any() for grad in grads.values())


HARD = {
    "opacity 0": one(opacity=0.0, features=(1.0,) * 3),
    "opacity 1": one(opacity=1.0, features=(1.0,) * 3),
    "opacity 1 in a pixel's centre": one((1 / 30, 1 / 30, 2.0), opacity=1.0, features=(1.0,) * 3),
    "scale 1e-6": one(scale=(1e-6,) * 3, features=(1.0,) * 3),
    "scale 1e3": one(scale=(1e3,) * 3, features=(1.0,) * 3),
    "needle": one(scale=(1.0, 1e-4, 1e-4), quat=(0.9, 0.1, 0.3, 0.3), features=(1.0,) * 3),
    "pancake": one(scale=(1.0, 1.0, 1e-4), quat=(0.5, 0.6, 0.3, 0.3), features=(1.0,) * 3),
    "zero quaternion": one(quat=(0.0,) * 4, scale=(0.1, 0.2, 0.3), features=(1.0,) * 3),
    "tiny quaternion": one(quat=(1e-15, 2e-15, 0.0, 0.0), scale=(0.1, 0.2, 0.3)),
    "huge quaternion": one(quat=(1e15, 2e15, 0.0, 0.0), scale=(0.1, 0.2, 0.3)),
    "just past the near plane": one((0.001, 0.0, 0.0101), scale=(0.01,) * 3),
    "off-axis, close": one((3.0, 0.0, 0.2), scale=(1.0,) * 3),
    "larger than the image": one(scale=(10.0,) * 3, opacity=0.5),
}
HARD = {k: replace(v, features=v.features[..., :1].expand(1, 1, 3)) for k, v in HARD.items()}


@every_backend
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", list(HARD))
def test_hard_gaussians(backend, dtype, case):
    gaussians, cam = join(HARD[case], cloud(15)).to(dtype), camera(dtype=dtype)
    for settings in (DENSE, ACCURACY["high"], CUT):
        got, got_grads = draw(gaussians, cam, settings, backend)
        wide = replace(settings, dtype="float64")
        want, want_grads = draw(
            gaussians.to(torch.float64), cam.to(torch.float64), wide, "reference"
        )
        tolerance = 1e-9 if dtype == torch.float64 and settings.dtype == "float64" else 2e-4
        assert error(got.features, want.features) < tolerance
        assert error(got.alpha, want.alpha) < tolerance
        for name, grad in want_grads.items():
            assert torch.isfinite(got_grads[name]).all(), name
            assert error(got_grads[name], grad) < 10 * tolerance, name


@fast_backend
@pytest.mark.parametrize("settings", [DENSE, replace(CUT, alpha_max=0.9)], ids=["dense", "capped"])
def test_alpha_at_the_cap(backend, settings):
    gaussians = cloud(40, scale=0.3, opacity=(0.95, 1.0))
    assert_like_reference(gaussians, camera((9, 9)), settings, backend)


@fast_backend
@pytest.mark.parametrize(
    ("settings", "opacity"),
    [
        (DENSE, 0.5),
        (CUT, 0.01),
        pytest.param(DENSE, 0.01, marks=pytest.mark.slow),
        pytest.param(CUT, 0.5, marks=pytest.mark.slow),
    ],
)
def test_5000_layers_on_one_pixel(backend, settings, opacity):
    n = 5000
    g = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
        + 1e-3 * torch.rand(1, n, 3, generator=g, dtype=torch.float64),
        torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(1, n, 4),
        torch.full((1, n, 3), 0.1, dtype=torch.float64),
        torch.full((1, n), opacity, dtype=torch.float64),
        torch.rand(1, n, 3, generator=g, dtype=torch.float64),
    )
    assert_like_reference(gaussians, camera((2, 3)), settings, backend)


@every_backend
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_of_an_opaque_layer_includes_the_layer_behind(backend, dtype):
    # Layers behind alpha = 1 are invisible, but are in the gradient of the opaque layer:
    # d image / d alpha_front = c_front - c_back, exactly.
    front = one((1 / 30, 1 / 30, 2.0), scale=(0.1,) * 3, opacity=1.0, features=(0.75,))
    back = one((1 / 30, 1 / 30, 3.0), scale=(50.0,) * 3, opacity=1.0, features=(0.25,))
    gaussians = leaves(join(front, back).to(dtype))
    cam = camera((24, 32), dtype=dtype)
    raster = rasterise(gaussians, cam, settings=DENSE, backend=backend)
    raster.features[0, 0, 12, 16].backward()
    want = torch.tensor([[0.5, 0.0]], dtype=dtype)
    torch.testing.assert_close(gaussians.opacities.grad, want, rtol=0, atol=1e-6)
    want = torch.tensor([[[1.0], [0.0]]], dtype=dtype)
    torch.testing.assert_close(gaussians.features.grad, want, rtol=0, atol=1e-6)


@every_backend
def test_coincident_gaussians(backend):
    gaussians = one(opacity=0.01, features=(1.0,))
    n = 3000
    gaussians = Gaussians(
        *(v.expand(1, n, *v.shape[2:]) for v in list(vars(gaussians).values())[:5])
    )
    raster, grads = draw(gaussians, camera((3, 3)), DENSE, backend)
    variance = (30.0 * 0.1 / 2) ** 2 + 0.3
    centre = 1 - (1 - 0.01) ** n
    corner = 1 - (1 - 0.01 * math.exp(-0.5 * 2 / variance)) ** n
    assert raster.alpha[0, 0, 1, 1].item() == pytest.approx(centre, abs=1e-9)
    assert raster.alpha[0, 0, 0, 0].item() == pytest.approx(corner, abs=1e-9)
    assert all(torch.isfinite(grad).all() for grad in grads.values())


@every_backend
def test_world_offset_of_ten_kilometres(backend):
    # The numbers are rounded to float32 far from the origin first: the test is of the
    # rasteriser's additional error, so both images start from the same rounded numbers.
    offset = torch.tensor([1e4, -1e4, 1e4])
    cam = camera(dtype=torch.float32)
    cam = replace(cam, t=cam.t - offset)
    gaussians = cloud(40, dtype=torch.float32)
    gaussians = replace(gaussians, means=gaussians.means + offset)
    got = rasterise(gaussians, cam, settings="high", backend=backend)
    want = rasterise(gaussians.to(torch.float64), cam.to(torch.float64), settings="high")
    assert error(got.features, want.features) < 2e-5


@every_backend
def test_camera_inside_the_cloud(backend):
    gaussians = cloud(60, scale=0.2)
    gaussians = replace(gaussians, means=gaussians.means - torch.tensor([0.0, 0.0, 2.0]).double())
    assert_like_reference(gaussians, camera(), CUT, backend, value=1e-8, gradient=1e-6)


@every_backend
def test_gradients_only_where_requested(backend):
    gaussians = cloud(10)
    gaussians = replace(gaussians, features=gaussians.features.requires_grad_())
    raster = rasterise(gaussians, camera(), settings=CUT, backend=backend)
    raster.features.sum().backward()
    # The sum of an image is linear in the features.
    total = (gaussians.features.grad * gaussians.features.detach()).sum()
    torch.testing.assert_close(total, raster.features.detach().sum())
    assert not rasterise(cloud(10), camera(), settings=CUT, backend=backend).alpha.requires_grad
