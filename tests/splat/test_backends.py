"""Every backend against analytic values, the naive loops, and the exact reference."""

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
    every_setting,
    fast_backend,
    gradients,
    join,
    leaves,
    naive,
    one,
    turned,
    with_covariances,
)

from gsgan.scene import cat
from gsgan.splat import ACCURACY, rasterise

# --- analytic values ---------------------------------------------------------------------------


@every_backend
@every_setting
def test_one_gaussian_matches_the_closed_form(backend, settings):
    scale, opacity, features = 0.1, 0.8, (1.0, 0.5, 0.25)
    cam = camera((9, 11), focal=20.0)
    gaussians = one(
        (0.0, 0.0, 2.0), scale=(scale,) * 3, opacity=opacity, features=features
    )
    raster = rasterise(gaussians, cam, settings=settings, backend=backend)
    variance = (20.0 * scale / 2) ** 2 + 0.3
    y, x = torch.meshgrid(
        torch.arange(9) + 0.5 - 4.5, torch.arange(11) + 0.5 - 5.5, indexing="ij"
    )
    alpha = opacity * torch.exp(-0.5 * (x * x + y * y).double() / variance)
    alpha[alpha < ACCURACY[settings].alpha_min] = 0
    torch.testing.assert_close(raster.alpha[0, 0], alpha, rtol=1e-6, atol=1e-7)
    for channel, value in zip(raster.features[0], features, strict=True):
        torch.testing.assert_close(channel, value * alpha, rtol=1e-6, atol=1e-7)


@every_backend
def test_two_layers_blend_front_to_back(backend):
    far = one((0, 0, 3.0), scale=(50.0,) * 3, opacity=0.5, features=(0.0, 1.0))
    near = one(
        (0, 0, 2.0), scale=(50.0,) * 3, opacity=0.25, features=(1.0, 0.0)
    )
    raster = rasterise(
        join(far, near), camera((1, 1)), settings=DENSE, backend=backend
    )
    torch.testing.assert_close(
        raster.features.flatten(), torch.tensor([0.25, 0.375]).double()
    )
    assert raster.alpha.item() == pytest.approx(1 - 0.75 * 0.5)


@every_backend
@pytest.mark.parametrize("shape", ["quats", "covariances"])
def test_equals_naive_loops(backend, shape):
    gaussians, cam = cloud(25), turned(camera((17, 23), focal=18.0))
    gaussians = (
        with_covariances(gaussians) if shape == "covariances" else gaussians
    )
    image, alpha = naive(gaussians, cam)
    raster = rasterise(gaussians, cam, settings=DENSE, backend=backend)
    torch.testing.assert_close(raster.features[0], image, rtol=0, atol=1e-10)
    torch.testing.assert_close(raster.alpha[0, 0], alpha, rtol=0, atol=1e-10)


# --- gradients ---------------------------------------------------------------------------------


@fast_backend
@pytest.mark.parametrize("settings", [DENSE, CUT], ids=["dense", "cut"])
@pytest.mark.parametrize(
    ("n", "channels", "size"), [(60, 3, (24, 32)), (200, 1, (33, 17))]
)
def test_equals_the_reference_with_the_same_settings(
    backend, settings, n, channels, size
):
    assert_like_reference(
        cloud(n, channels), turned(camera(size)), settings, backend
    )


@fast_backend
@every_setting
def test_float32_is_near_the_reference_in_float64(backend, settings):
    gaussians, cam = cloud(150), turned(camera())
    setting = ACCURACY[settings]
    got, got_grads = draw(
        gaussians.to(torch.float32), cam.to(torch.float32), setting, backend
    )
    want, want_grads = draw(
        gaussians, cam, replace(setting, dtype="float64"), "reference"
    )
    assert got.features.dtype == torch.float32
    # An alpha that rounding moves across alpha_min changes the pixel by at most alpha_min.
    assert error(got.features, want.features) < 5e-6 + setting.alpha_min
    for name, grad in want_grads.items():
        off = (got_grads[name].double() - grad).norm() / grad.norm()
        assert off < 1e-4 + 2 * setting.alpha_min, name


@every_backend
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_of_an_opaque_layer_includes_the_layer_behind(backend, dtype):
    # Layers behind alpha = 1 are invisible, but are in the gradient of the opaque layer:
    # d image / d alpha_front = c_front - c_back, exactly.
    front = one(
        (1 / 30, 1 / 30, 2.0), scale=(0.1,) * 3, opacity=1.0, features=(0.75,)
    )
    back = one(
        (1 / 30, 1 / 30, 3.0), scale=(50.0,) * 3, opacity=1.0, features=(0.25,)
    )
    gaussians = leaves(join(front, back).to(dtype))
    raster = rasterise(
        gaussians, camera(dtype=dtype), settings=DENSE, backend=backend
    )
    raster.features[0, 0, 12, 16].backward()
    want = torch.tensor([[0.5, 0.0]], dtype=dtype)
    torch.testing.assert_close(
        gaussians.opacities.grad, want, rtol=0, atol=1e-6
    )
    want = torch.tensor([[[1.0], [0.0]]], dtype=dtype)
    torch.testing.assert_close(gaussians.features.grad, want, rtol=0, atol=1e-6)


@every_backend
def test_gradients_only_where_requested(backend):
    gaussians = cloud(10)
    gaussians = replace(gaussians, features=gaussians.features.requires_grad_())
    raster = rasterise(gaussians, camera(), settings=CUT, backend=backend)
    raster.features.sum().backward()
    # The sum of an image is linear in the features.
    total = (gaussians.features.grad * gaussians.features.detach()).sum()
    torch.testing.assert_close(total, raster.features.detach().sum())
    assert not rasterise(
        cloud(10), camera(), settings=CUT, backend=backend
    ).alpha.requires_grad


# --- accuracy settings -------------------------------------------------------------------------


@every_backend
def test_finer_settings_are_more_accurate(backend):
    gaussians, cam = cloud(300), camera()
    want = rasterise(gaussians, cam, settings="exact").features
    errors = [
        float(
            (
                rasterise(gaussians, cam, settings=s, backend=backend).features
                - want
            )
            .abs()
            .max()
        )
        for s in ("high", "standard", "draft")
    ]
    assert errors[0] < 1e-4 < 1e-3 < errors[1] < errors[2] < 0.1


@fast_backend
def test_sigma_extent_skips_the_same_pixels(backend):
    narrow = replace(DENSE, name="narrow", extent="sigma", radius_sigmas=1.5)
    assert_like_reference(cloud(50), camera(), narrow, backend)


@every_backend
def test_antialias_keeps_the_energy_of_a_small_gaussian(backend):
    # A Gaussian far below a pixel: with compensation its total alpha is o times its own area
    # (2 pi sigma²), not the area that the low-pass gives it.
    sigma = 0.05
    gaussians = one((0.0, 0.0, 2.0), scale=(sigma * 2 / 30,) * 3, opacity=0.5)
    settings = replace(DENSE, antialias=True)
    raster = rasterise(
        gaussians, camera((25, 25)), settings=settings, backend=backend
    )
    # Sampled at pixel centres, a Gaussian of variance v sums to 1 + 4 exp(-2 pi² v) of its area.
    sampling = 1 + 4 * math.exp(
        -2 * math.pi**2 * (sigma**2 + settings.low_pass)
    )
    want = 0.5 * 2 * math.pi * sigma**2 * sampling
    assert raster.alpha.sum().item() == pytest.approx(want, rel=1e-4)


# --- order, batches, determinism ---------------------------------------------------------------


@every_backend
def test_a_batch_equals_its_items(backend):
    gaussians = cat([cloud(50, seed=1), cloud(50, seed=2)])
    cam = cat([camera(), turned(camera(focal=40.0))])
    both, both_grads = draw(gaussians, cam, CUT, backend)
    for i in range(2):
        g, c = leaves(gaussians[i : i + 1]), leaves(cam[i : i + 1])
        single = rasterise(g, c, settings=CUT, backend=backend)
        assert torch.equal(single.features, both.features[i : i + 1])
        assert torch.equal(single.alpha, both.alpha[i : i + 1])
        weights = torch.Generator().manual_seed(7)
        total = 0.0
        for whole, part in (
            (both.features, single.features),
            (both.alpha, single.alpha),
        ):
            w = torch.randn(
                whole.shape, generator=weights, dtype=torch.float64
            )[i : i + 1]
            total = total + (part * w).sum()
        total.backward()
        for name, grad in gradients(g, c).items():
            torch.testing.assert_close(
                grad, both_grads[name][i : i + 1], rtol=1e-9, atol=1e-12
            )


@every_backend
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_same_input_gives_the_same_bits(backend, dtype):
    gaussians, cam = cloud(200, dtype=dtype), camera(dtype=dtype)
    first, first_grads = draw(gaussians, cam, "high", backend)
    second, second_grads = draw(gaussians, cam, "high", backend)
    assert torch.equal(first.features, second.features)
    for name, grad in first_grads.items():
        assert torch.equal(grad, second_grads[name]), name
