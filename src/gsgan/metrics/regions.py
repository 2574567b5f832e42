"""Images as they are scored: background, 8 bits, regions.

Convention: images ``[B, 3, H, W]`` RGB in [0, 1]; masks ``[B, 1, H, W]``; a background is a grey
value, 0 black or 1 white.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.metrics.image import person_box

BACKGROUNDS = {"black": 0.0, "white": 1.0}
CROP_MARGIN = 50  # pixels round the mask's box in LPIPS' crop
CROP_SIZE = 512  # pixels to which it is resized
CUT_SLACK = 1e-3  # of 1/255: values that are 8-bit already must not drop by one


def on_background(image: Tensor, alpha: Tensor, background: float) -> Tensor:
    """Puts an image on black, premultiplied by its alpha, on another background."""
    return image + (1 - alpha) * background


def moved_background(image: Tensor, mask: Tensor, old: float, new: float) -> Tensor:
    """Moves an opaque image from one background to another by the ground truth's mask.

    What the image shows outside the mask leaves [0, 1] and is lost: errors of the outline hide.
    """
    return (image + (1 - mask) * (new - old)).clamp(0, 1)


def hard_outline(image: Tensor, mask: Tensor) -> Tensor:
    """Divides an image on black by its mask where that is at least one half; black elsewhere."""
    inside = mask >= 0.5
    return torch.where(inside, (image / mask.clamp_min(0.5)).clamp(0, 1), torch.zeros_like(image))


def eight_bits(image: Tensor, how: Literal["none", "rounded", "cut"]) -> Tensor:
    """The values of an 8-bit file, "rounded" or "cut"; "none" leaves them unchanged."""
    if how == "none":
        return image
    steps = image.clamp(0, 1) * 255
    return (steps.round() if how == "rounded" else (steps + CUT_SLACK).floor()) / 255


def cleared(image: Tensor, keep: Tensor, background: float) -> Tensor:
    """The background wherever ``keep`` is false."""
    return torch.where(keep, image, image.new_tensor(background))


def rectangle(where: Tensor, least: int = 1) -> tuple[slice, slice] | None:
    """Rows and columns of the smallest rectangle round ``where [1, H, W]``; None if it is empty.

    Args:
        where: bool.
        least: minimum side in pixels, limited by the image.
    """
    rows, columns = (where[0].any(dim=d).nonzero().flatten().tolist() for d in (1, 0))
    if not rows:
        return None
    height, width = where.shape[-2:]
    return _widened(rows[0], rows[-1] + 1, height, least), _widened(
        columns[0], columns[-1] + 1, width, least
    )


def _widened(start: int, stop: int, size: int, least: int) -> slice:
    side = min(max(stop - start, least), size)
    start = min(max(start - (side - (stop - start)) // 2, 0), size - side)
    return slice(start, start + side)


def mask_crop(
    image: Tensor,
    mask: Tensor,
    background: float,
    *,
    margin: int = CROP_MARGIN,
    size: int = CROP_SIZE,
) -> Tensor | None:
    """The mask's box and a margin, centred in a square of the background, resized.

    Convention: as in the script, the box ends one pixel early at the bottom and right, and resizing
    is bilinear without antialiasing.

    Args:
        image: ``[3, H, W]``.
        mask: ``[1, H, W]``; its box contains the pixels of at least one half.
        background: fills the square.
        margin: pixels round the box, limited by the image.
        size: side of the result in pixels.

    Returns:
        ``[3, size, size]``, or None where the mask is empty.

    Source: the scoring script of THuman4.0's protocol.
    """
    box = rectangle(person_box(mask[None])[0])
    if box is None:
        return None
    rows, columns = (slice(max(s.start - margin, 0), s.stop - 1 + margin) for s in box)
    part = image[:, rows, columns]
    height, width = part.shape[-2:]
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    border = (left, side - width - left, top, side - height - top)
    square = functional.pad(part, border, value=background)[None]
    if side != size:
        square = functional.interpolate(square, (size, size), mode="bilinear", align_corners=False)
    return square[0]
