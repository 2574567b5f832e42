"""Needles hundreds of pixels long, in float32, against the float64 reference: values and gradients.

Their exponent is a difference of terms that grow with the square of the length; each case lies in
another direction, or the needle is looked at far from its mean.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from splat_scenes import BACKENDS, camera, gradients, leaves, loss

from gsgan.scene import Camera, Gaussians
from gsgan.splat import ACCURACY, project, rasterise

SIZE, FOCAL, DEPTH = 96, 400.0, 2.0
# An alpha that rounding moves across alpha_min would dominate the error.
HIGH = replace(ACCURACY["high"], alpha_min=1e-10)
# The reference in float32 takes means in image coordinates: that rounds them to 1e-5 pixels.
VALUE = {"reference": 1e-5, "torch": 1e-5, "native": 1e-6}
GRADIENT = {"reference": 5e-4, "torch": 1e-4, "native": 5e-5}


def needles(degrees: float, pixels: float, away: float = 0.0) -> tuple[Gaussians, Camera]:
    """Three needles 1e4 : 1, ``pixels`` long (one sigma), in float32.

    ``away`` moves their means out of the image, along the needle, by so many sigmas.
    """
    g = torch.Generator().manual_seed(0)
    length, angle = pixels * DEPTH / FOCAL, math.radians(degrees)
    along = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
    scatter = torch.tensor([0.1, 0.1, 0.0], dtype=torch.float64)
    scatter = scatter * (torch.rand(1, 3, 3, generator=g, dtype=torch.float64) - 0.5)
    means = torch.tensor([0.0, 0.0, DEPTH], dtype=torch.float64) + scatter + away * length * along
    quats = torch.tensor([math.cos(angle / 2), 0, 0, math.sin(angle / 2)], dtype=torch.float64)
    scales = torch.tensor([length, length * 1e-4, length * 1e-4], dtype=torch.float64)
    features = torch.rand(1, 3, 2, generator=g, dtype=torch.float64)
    gaussians = Gaussians(
        means,
        quats.expand(1, 3, 4).clone(),
        scales.expand(1, 3, 3).clone(),
        torch.full((1, 3), 0.8, dtype=torch.float64),
        features,
    )
    cam = camera((SIZE, SIZE), focal=FOCAL)
    return gaussians.to(torch.float32), cam.to(torch.float32)


def draw(gaussians, cam, settings, backend):
    gaussians, cam = leaves(gaussians), leaves(cam)
    raster = rasterise(gaussians, cam, settings=settings, backend=backend)
    loss(raster).backward()
    return raster, gradients(gaussians, cam)


def assert_like_the_reference(backend, degrees, pixels, away=0.0):
    gaussians, cam = needles(degrees, pixels, away)
    got, got_grads = draw(gaussians, cam, HIGH, backend)
    exact = replace(HIGH, dtype="float64")
    wide = (gaussians.to(torch.float64), cam.to(torch.float64))
    want, want_grads = draw(*wide, exact, "reference")
    assert want.alpha.max() > 0.01  # there is something to see
    assert (got.features.double() - want.features).abs().max() < VALUE[backend]
    for name, grad in want_grads.items():
        off = (got_grads[name].double() - grad).abs().max() / grad.abs().max()
        assert off < GRADIENT[backend], name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("degrees", [0.0, 0.1, 5.0, 45.0, 85.0, 89.9, 90.0, 135.0])
@pytest.mark.parametrize("pixels", [300.0, 3000.0])
def test_float32_needles_equal_the_reference(backend, degrees, pixels):
    assert_like_the_reference(backend, degrees, pixels)


@pytest.mark.parametrize("backend", [b for b in BACKENDS if b != "reference"])
@pytest.mark.parametrize("degrees", [0.0, 30.0, 45.0, 90.0])
@pytest.mark.parametrize("pixels", [300.0, 3000.0])
def test_needles_whose_means_are_thousands_of_pixels_away(backend, degrees, pixels):
    # Not of the reference in float32: it rounds means where the others round differences.
    assert_like_the_reference(backend, degrees, pixels, away=2.0)


@pytest.mark.parametrize("degrees", [0.0, 0.1, 45.0, 89.9, 90.0])
@pytest.mark.parametrize("length", [300.0, 1e5])
def test_factors_match_the_covariance(degrees, length):
    # Σ = L² d dᵀ + low-pass: along the needle q = s² / (L² + 0.3), across it q = s² / 0.3.
    p = project(*(x.to(torch.float64) for x in needles(degrees, length)), HIGH)
    angle = math.radians(degrees)
    factor_p, k, r = p.factors[0, 0].tolist()
    for sigma, dx, dy in (
        (math.hypot(length, math.sqrt(0.3)), math.cos(angle), math.sin(angle)),
        (math.sqrt(0.3 + (length * 1e-4) ** 2), -math.sin(angle), math.cos(angle)),
    ):
        q = (factor_p * sigma * (dx + k * dy)) ** 2 + (r * sigma * dy) ** 2
        # The quaternion was rounded to float32: that turns the needle by 1e-7.
        assert q == pytest.approx(1.0, abs=2e-3 if length > 1e4 else 1e-4)
