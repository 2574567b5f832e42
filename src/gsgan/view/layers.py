"""The viewer's layers: the image, or one of the maps that it is made from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.model.avatar import Avatar
from gsgan.model.rendering import Rendering
from gsgan.scene import Camera
from gsgan.splat import rasterise
from gsgan.utils.images import eight_bits

if TYPE_CHECKING:
    from gsgan.scene import Frame

Bytes = NDArray[np.uint8]

IMAGE, COLOUR, PARTS, ALPHA = "image", "Step I's colour", "segmentation S", "alpha"
DEPTH, FEATURE, ERROR = "depth", "feature channel", "error against truth"
ERROR_SCALE = 4.0  # differences from 1/4 on have the brightest colour


def layers(avatar: Avatar, truth: bool) -> tuple[str, ...]:
    """The layers of an avatar, with the error if there is a ground truth."""
    names = [IMAGE, ALPHA]
    if avatar.splats is not None:
        names += [COLOUR, DEPTH]
    if avatar.splat_channels > 3:
        names.append(FEATURE)
    if avatar.segmentation is not None:
        names.append(PARTS)
    return (*names, *[ERROR] * truth)


def shown(
    layer: str,
    rendering: Rendering,
    camera: Camera,
    avatar: Avatar,
    behind: Tensor,
    channel: int = 0,
    truth: Frame | None = None,
) -> Bytes:
    """``[H, W, 3]`` one layer of a rendering.

    Args:
        layer: of `layers`.
        rendering: with maps, unless the layer is the image.
        camera: of the rendering, on any device.
        avatar: that was rendered.
        behind: ``[3, H, W]`` the background.
        channel: of F, for the feature layer; its values are stretched to the colour map's range.
        truth: the frame with the ground truth, for the error layer.
    """
    assert rendering.image is not None and rendering.alpha is not None  # noqa: PT018
    image, alpha = rendering.image[0].cpu(), rendering.alpha[0].cpu()
    if layer == ALPHA:
        return _grey(alpha[0])
    if layer == ERROR and truth is not None:
        error = (image.clamp(0, 1) - truth.image[0]).abs().mean(dim=0)
        return _coloured(error * ERROR_SCALE)
    if layer == PARTS and rendering.segmentation is not None:
        return _parts(rendering.segmentation[0].cpu())
    if layer == COLOUR and rendering.features is not None and rendering.splat_alpha is not None:
        return eight_bits(rendering.features[0, :3].cpu(), rendering.splat_alpha[0].cpu(), behind)
    if layer == FEATURE and rendering.features is not None:
        return _coloured(_stretched(rendering.features[0, 3 + channel].cpu()))
    if layer == DEPTH and rendering.gaussians is not None:
        return _depth(rendering, camera, avatar)
    return eight_bits(image, alpha, behind)


def _depth(rendering: Rendering, camera: Camera, avatar: Avatar) -> Bytes:
    gaussians = rendering.gaussians
    assert gaussians is not None
    camera = camera.to(gaussians.means.device)
    raster = rasterise(gaussians, camera, settings=avatar.accuracy, depth=True)
    assert raster.depth is not None
    alpha = raster.alpha[0, 0].cpu()
    metres = raster.depth[0, 0].cpu() / alpha.clamp_min(1e-6)
    seen = alpha > 0.5
    mean = torch.where(seen, metres, 0.0).sum() / seen.sum().clamp_min(1)
    near = 1 - _stretched(torch.where(seen, metres, mean))
    return _coloured(near) * seen.numpy()[..., None]


def _parts(probabilities: Tensor) -> Bytes:
    """Classes ``[classes, H, W]`` in colours of the wheel, background black."""
    import matplotlib

    count = len(probabilities)
    wheel = matplotlib.colormaps["hsv"](np.linspace(0, 1, count)[:, None] % 1)[:, 0, :3]
    wheel[0] = 0
    mixed = np.einsum("chw,ck->hwk", probabilities.numpy(), wheel)
    return np.asarray((mixed.clip(0, 1) * 255).astype(np.uint8))


def _stretched(x: Tensor) -> Tensor:
    low, high = torch.aminmax(x)
    return (x - low) / (high - low).clamp_min(1e-6)


def _grey(x: Tensor) -> Bytes:
    return np.repeat((x.clamp(0, 1) * 255).byte().numpy()[..., None], 3, axis=2)


def _coloured(x: Tensor) -> Bytes:
    import matplotlib

    return np.asarray(matplotlib.colormaps["turbo"](x.clamp(0, 1).numpy(), bytes=True)[..., :3])


def fitted(image: Bytes, aspect: float) -> Bytes:
    """The image, padded with black until its width is ``aspect`` times its height."""
    height, width = image.shape[:2]
    want: Sequence[int] = (
        (height, round(height * aspect))
        if aspect * height >= width
        else (round(width / aspect), width)
    )
    room = [(b - a) // 2 for a, b in zip((height, width), want, strict=True)]
    sides = [(r, b - a - r) for r, a, b in zip(room, (height, width), want, strict=True)]
    return np.pad(image, (*sides, (0, 0)))
