"""Small scenes for the rasteriser's hard cases, and how they are rendered.

Convention: scenes are dicts of float64 tensors with a batch of one: ``means quats scales opacities
features`` (or ``covariances``) and ``K R t``. Ordinary Gaussians beside the hard ones are inputs of
their own, ``other means`` and so on, so that the gradients of the hard ones are compared by their
own size. Metres and pixels; the camera is at the origin and looks along +z unless stated otherwise.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gsgan.scene import Camera, Gaussians
from gsgan.splat import ACCURACY, Accuracy, rasterise
from stability.cases.case import Case, Inputs, Outputs

HIGH = ACCURACY["high"]

SIZE = (24, 32)
"""Height and width of the images, pixels."""

FOCAL = 30.0
"""Focal length, pixels: the image is about one metre wide a metre away."""

ON_PIXEL = (0.5 * 2 / FOCAL, 0.5 * 2 / FOCAL, 2.0)
"""Two metres away, exactly on the centre of the pixel right below the image's middle."""

Numbers = Sequence[float]
Size = tuple[int, int]
_GAUSSIANS = (
    "means",
    "quats",
    "scales",
    "covariances",
    "opacities",
    "features",
)


def raster_case(
    subject: str,
    name: str,
    scene: Callable[[], Inputs],
    *,
    size: Size = SIZE,
    settings: Accuracy = HIGH,
    draw: Callable[..., Outputs] | None = None,
    **options: Any,
) -> Case:
    """A case that runs on each backend of the rasteriser, drawn by ``draw`` (default: `render`)."""
    run = partial(draw or render, size=size, settings=settings)
    return Case(subject, name, scene, run, settings, **options)


def render(
    inputs: Inputs, backend: str, *, size: Size, settings: Accuracy
) -> dict[str, Tensor]:
    """Features, alpha and depth of a scene; depths are drawn as one more channel."""
    gaussians, camera = records(inputs, size)
    # in float64, as the rasteriser computes geometry
    wide = camera.to(torch.float64).to_camera(gaussians.means.double())
    depths = wide[..., 2:].to(gaussians.means)
    values = torch.cat([gaussians.features, depths], dim=-1)
    raster = rasterise(
        replace(gaussians, features=values),
        camera,
        settings=settings,
        backend=backend,
    )
    features, depth = raster.features[:, :-1], raster.features[:, -1:]
    return {"features": features, "alpha": raster.alpha, "depth": depth}


def rendered(
    gaussians: Gaussians,
    inputs: Inputs,
    backend: str,
    size: Size,
    settings: Accuracy,
) -> dict[str, Tensor]:
    """Features and alpha of Gaussians that a case made, seen by the camera of its inputs."""
    camera = Camera(inputs["K"], inputs["R"], inputs["t"], size)
    raster = rasterise(gaussians, camera, settings=settings, backend=backend)
    return {"features": raster.features, "alpha": raster.alpha}


def records(inputs: Inputs, size: Size) -> tuple[Gaussians, Camera]:
    """The scene as the records that ``rasterise`` takes."""
    parts: dict[str, Any] = {name: _joined(inputs, name) for name in _GAUSSIANS}
    return Gaussians(**parts), Camera(
        inputs["K"], inputs["R"], inputs["t"], size
    )


def _joined(inputs: Inputs, name: str) -> Tensor | None:
    parts = [inputs[key] for key in (name, f"other {name}") if key in inputs]
    return torch.cat(parts, dim=1) if parts else None


def among(others: Inputs, hard: Inputs) -> Inputs:
    """The hard Gaussians first, then the others, as inputs of their own."""
    return {
        **hard,
        **{f"other {name}": value for name, value in others.items()},
    }


def uncut(settings: Accuracy) -> Accuracy:
    """The same settings without a cut-off."""
    return replace(
        settings,
        name="uncut",
        alpha_min=0.0,
        transmittance_min=0.0,
        extent="all",
    )


def pinhole(
    size: Size = SIZE,
    focal: float = FOCAL,
    *,
    skew: float = 0.0,
    centre: tuple[float, float] | None = None,
    aspect: float = 1.0,
    axis_angle: Numbers = (0.0, 0.0, 0.0),
    t: Numbers = (0.0, 0.0, 0.0),
) -> Inputs:
    """K, R and t; the principal point (x, y) is the image's middle unless given."""
    x, y = centre or (size[1] / 2, size[0] / 2)
    K = torch.tensor(
        [[focal, skew, x], [0.0, focal * aspect, y], [0.0, 0.0, 1.0]]
    )
    return {
        "K": K.double().unsqueeze(0),
        "R": rotation(axis_angle).unsqueeze(0),
        "t": torch.tensor([list(t)], dtype=torch.float64),
    }


def rotation(axis_angle: Numbers) -> Tensor:
    """``[3, 3]`` rotation matrix of an axis times an angle in radians."""
    x, y, z = axis_angle
    skew = torch.tensor(
        [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64
    )
    return torch.matrix_exp(skew)


def gaussians(
    means: Sequence[Numbers],
    *,
    scales: Numbers = (0.1, 0.13, 0.08),
    quat: Numbers = (1.0, 0.0, 0.0, 0.0),
    opacity: float = 0.8,
) -> Inputs:
    """Gaussians of one shape at given places; random colours."""
    n = len(means)
    generator = torch.Generator().manual_seed(1)
    return {
        "means": torch.tensor(
            [[list(mean) for mean in means]], dtype=torch.float64
        ),
        "quats": torch.tensor(list(quat), dtype=torch.float64).repeat(1, n, 1),
        "scales": torch.tensor(list(scales), dtype=torch.float64).repeat(
            1, n, 1
        ),
        "opacities": torch.full((1, n), opacity, dtype=torch.float64),
        "features": torch.rand(
            1, n, 3, generator=generator, dtype=torch.float64
        ),
    }


def cloud(
    n: int = 12,
    channels: int = 3,
    *,
    batch: int = 1,
    seed: int = 0,
    scale: float = 0.08,
    opacity: tuple[float, float] = (0.05, 0.95),
    middle: Numbers = (0.0, 0.0, 2.0),
    extent: Numbers = (1.6, 1.2, 1.0),
) -> Inputs:
    """Random Gaussians that fill most of the image, two metres away."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(
            batch, n, *shape, generator=generator, dtype=torch.float64
        )

    low, high = opacity
    place = torch.tensor([list(extent), list(middle)], dtype=torch.float64)
    return {
        "means": (rand(3) - 0.5) * place[0] + place[1],
        "quats": rand(4) * 2 - 1,
        "scales": scale * torch.exp(rand(3) * 2 - 1),
        "opacities": low + (high - low) * rand(),
        "features": rand(channels),
    }
