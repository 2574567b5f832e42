"""The viewer's layers: the image, or one of the maps that it is made from."""

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gsgan.metrics.segmentation import colour_labels
from gsgan.model.avatar import Avatar
from gsgan.model.rendering import Rendering
from gsgan.utils.images import eight_bits

Bytes = NDArray[np.uint8]

IMAGE, COLOUR, PARTS, ALPHA = "image", "Step I's colour", "segmentation S", "alpha"


def layers(avatar: Avatar) -> tuple[str, ...]:
    """The layers of an avatar."""
    names = [IMAGE, ALPHA]
    if avatar.splats is not None:
        names.append(COLOUR)
    if avatar.segmentation is not None:
        names.append(PARTS)
    return tuple(names)


def shown(layer: str, rendering: Rendering, behind: Tensor) -> Bytes:
    """``[H, W, 3]`` one layer of a rendering.

    Args:
        layer: of `layers`.
        rendering: with maps, unless the layer is the image.
        behind: ``[3, H, W]`` the background.
    """
    assert rendering.image is not None and rendering.alpha is not None  # noqa: PT018
    image, alpha = rendering.image[0].cpu(), rendering.alpha[0].cpu()
    if layer == ALPHA:
        return _grey(alpha[0])
    if layer == PARTS and rendering.segmentation is not None:
        colours = colour_labels(rendering.segmentation.argmax(dim=1))[0]
        return np.asarray((colours.permute(1, 2, 0) * 255).byte().cpu().numpy())
    if layer == COLOUR and rendering.features is not None and rendering.splat_alpha is not None:
        return eight_bits(rendering.features[0, :3].cpu(), rendering.splat_alpha[0].cpu(), behind)
    return eight_bits(image, alpha, behind)


def _grey(x: Tensor) -> Bytes:
    return np.repeat((x.clamp(0, 1) * 255).byte().numpy()[..., None], 3, axis=2)
