"""Finite differences in float64, beyond test_backends.py: colour, projection alone."""

from dataclasses import replace

import pytest
import torch
from splat_scenes import (
    camera,
    cloud,
    every_backend,
    needs_native,
    turned,
    with_covariances,
)

from gsgan.splat import (
    ACCURACY,
    native_project,
    project,
    rasterise,
    sh_to_colour,
)

EXACT = ACCURACY["exact"]
DRAWN = ("means", "factors", "opacities", "depths")

every_shape = pytest.mark.parametrize("shape", ["quats", "covariances"])


def scene(shape: str, n: int = 3, batch: int = 1):
    """A few Gaussians, a small camera, and the names of the given tensors."""
    gaussians = cloud(n, 2, scale=0.15, batch=batch)
    gaussians = (
        with_covariances(gaussians) if shape == "covariances" else gaussians
    )
    names = [
        name for name, value in vars(gaussians).items() if value is not None
    ]
    return (
        gaussians,
        turned(camera((3, 4), focal=4.0, batch=batch), skew=0.7, offset=0.5),
        names,
    )


def checked(function, *tensors) -> bool:
    inputs = [x.detach().clone().requires_grad_() for x in tensors]
    return torch.autograd.gradcheck(
        function, inputs, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True
    )


def pinhole(K, like):
    """Only the entries that a pinhole has: the rasteriser refuses others."""
    entries = K.new_tensor([[1, 1, 1], [0, 1, 1], [0, 0, 0]])
    return K * entries + like.K * (1 - entries)


@every_backend
@pytest.mark.parametrize("degree", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_view_dependent_colours(backend, degree):
    gaussians, cam, _ = scene("quats")
    g = torch.Generator().manual_seed(1)
    sh = 0.3 * torch.randn(
        1, 3, (degree + 1) ** 2, 3, generator=g, dtype=torch.float64
    )

    def image(sh, means, R, t):
        seen_by = replace(cam, R=R, t=t)
        colours = sh_to_colour(sh, means - seen_by.centre.unsqueeze(1))
        seen = replace(gaussians, means=means, features=colours)
        raster = rasterise(seen, seen_by, settings=EXACT, backend=backend)
        return raster.features

    assert checked(image, sh, gaussians.means, cam.R, cam.t)


@every_backend
@every_shape
def test_antialiased_batches(backend, shape):
    gaussians, cam, names = scene(shape, n=2, batch=2)
    settings = replace(EXACT, antialias=True)

    def image(*tensors):
        given = replace(gaussians, **dict(zip(names, tensors, strict=False)))
        K, R, t = tensors[len(names) :]
        seen_by = replace(cam, K=pinhole(K, cam), R=R, t=t)
        raster = rasterise(given, seen_by, settings=settings, backend=backend)
        return raster.features, raster.alpha

    assert checked(
        image,
        *(getattr(gaussians, name) for name in names),
        cam.K,
        cam.R,
        cam.t,
    )


@pytest.mark.parametrize(
    "projection",
    [project, pytest.param(native_project.project, marks=needs_native)],
)
@every_shape
@pytest.mark.parametrize("antialias", [False, True])
def test_projection_alone(projection, shape, antialias):
    gaussians, cam, names = scene(shape)
    # The second is where the Jacobian is clamped: its gradient reaches K through the field of view.
    gaussians.means[0, 1] = torch.tensor([4.0, -3.0, 2.0])
    settings = replace(EXACT, antialias=antialias)
    assert projection(gaussians, cam, settings).visible.all()

    def ellipses(*tensors):
        given = replace(gaussians, **dict(zip(names, tensors, strict=False)))
        K, R, t = tensors[len(names) :]
        projected = projection(given, replace(cam, K=K, R=R, t=t), settings)
        return tuple(getattr(projected, name) for name in DRAWN)

    assert checked(
        ellipses,
        *(getattr(gaussians, name) for name in names),
        cam.K,
        cam.R,
        cam.t,
    )
