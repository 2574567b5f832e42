"""rasterise() as a PyTorch operator: what ``torch.export`` records in a program's place of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict

import torch
from torch import Tensor

from gsgan.scene import Camera, Gaussians, Raster
from gsgan.splat.settings import Accuracy

NAME = "gsgan::rasterise"
draw: Callable[..., Raster] | None = (
    None  # gsgan.splat.rasterise sets it, as that module calls this one
)


def rasterised(
    gaussians: Gaussians, camera: Camera, settings: Accuracy, backend: str, depth: bool
) -> Raster:
    """The operator's call; quats and scales are not supported, covariances are.

    Convention: no gradient.
    """
    assert gaussians.covariances is not None and not depth  # noqa: PT018  (as avatars splat)
    features, alpha, fine = _rasterise(
        *(gaussians.means, gaussians.covariances, gaussians.opacities, gaussians.features),
        *(camera.K, camera.R, camera.t, camera.dist, *camera.size),
        json.dumps(asdict(settings)),
        backend,
    )
    return Raster(features, alpha, None, fine if settings.supersample > 1 else None)


@torch.library.custom_op(NAME, mutates_args=())
def _rasterise(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    K: Tensor,
    R: Tensor,
    t: Tensor,
    dist: Tensor | None,
    height: int,
    width: int,
    settings: str,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor]:
    assert draw is not None
    made = draw(
        Gaussians(means, None, None, opacities, features, covariances),
        Camera(K, R, t, (height, width), dist),
        settings=Accuracy(**json.loads(settings)),
        backend=backend,
    )
    fine = features.new_empty(0) if made.fine is None else made.fine
    return tuple(x.contiguous() for x in (made.features, made.alpha, fine))  # type: ignore[return-value]


@_rasterise.register_fake
def _shapes(
    means: Tensor,
    covariances: Tensor,
    opacities: Tensor,
    features: Tensor,
    K: Tensor,
    R: Tensor,
    t: Tensor,
    dist: Tensor | None,
    height: int,
    width: int,
    settings: str,
    backend: str,
) -> tuple[Tensor, Tensor, Tensor]:
    B, _, C = features.shape
    k = json.loads(settings)["supersample"]
    fine = (B, C, k * height, k * width) if k > 1 else (0,)
    sizes = ((B, C, height, width), (B, 1, height, width), fine)
    return tuple(features.new_empty(size) for size in sizes)  # type: ignore[return-value]
