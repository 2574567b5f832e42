"""The picture as it is scored: background, 8 bits, and the parts that are looked at.

Convention: pictures ``[B, 3, H, W]`` RGB in [0, 1]; masks ``[B, 1, H, W]``; a background is a grey
value, 0 black or 1 white.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.metrics.image import person_box

BACKGROUNDS = {"black": 0.0, "white": 1.0}
CROP_MARGIN = 50  # pixels that LPIPS' crop takes round the mask's box
CROP_SIZE = 512  # pixels to which it is resized
CUT_SLACK = 1e-3  # of 1/255: keeps what is 8-bit already from falling to the number below


def on_background(image: Tensor, alpha: Tensor, background: float) -> Tensor:
    """A picture on black, premultiplied by its alpha, put on another background."""
    return image + (1 - alpha) * background


def moved_background(image: Tensor, mask: Tensor, old: float, new: float) -> Tensor:
    """An opaque picture moved from one background to another by a mask that is not its own.

    What it paints outside the mask is pushed beyond [0, 1] and lost: errors of the outline hide.
    """
    return (image + (1 - mask) * (new - old)).clamp(0, 1)


def hard_outline(image: Tensor, mask: Tensor) -> Tensor:
    """A picture on black, premultiplied by its mask, as it was taken before where the mask is at
    least one half, and black elsewhere."""
    inside = mask >= 0.5
    return torch.where(inside, (image / mask.clamp_min(0.5)).clamp(0, 1), torch.zeros_like(image))


def eight_bits(image: Tensor, how: Literal["none", "rounded", "cut"]) -> Tensor:
    """The values that an 8-bit file would hold, "rounded" or "cut"; "none" leaves them alone."""
    if how == "none":
        return image
    steps = image.clamp(0, 1) * 255
    return (steps.round() if how == "rounded" else (steps + CUT_SLACK).floor()) / 255


def cleared(image: Tensor, keep: Tensor, background: float) -> Tensor:
    """The background wherever ``keep`` is false."""
    return torch.where(keep, image, image.new_tensor(background))


def rectangle(where: Tensor, least: int = 1) -> tuple[slice, slice] | None:
    """Rows and columns of the smallest rectangle that holds ``where [1, H, W]``; None if empty.

    Args:
        where: bool.
        least: pixels, its least side, as far as the picture reaches.
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
    picture: Tensor,
    mask: Tensor,
    background: float,
    *,
    margin: int = CROP_MARGIN,
    size: int = CROP_SIZE,
) -> Tensor | None:
    """The person in a square: the mask's box and a margin, centred on the background, resized.

    Convention: as the script's, whose box ends one pixel early, below and to the right, and which
    resizes by interpolation between four pixels however much it shrinks.

    Args:
        picture: ``[3, H, W]``.
        mask: ``[1, H, W]``; the box holds where it is at least one half.
        background: fills the square.
        margin: pixels round the box; the picture's border cuts it off.
        size: pixels, side of the result.

    Returns:
        ``[3, size, size]``, or None where the mask is empty.

    Source: the scoring script of THuman4.0's protocol.
    """
    box = rectangle(person_box(mask[None])[0])
    if box is None:
        return None
    rows, columns = (slice(max(s.start - margin, 0), s.stop - 1 + margin) for s in box)
    part = picture[:, rows, columns]
    height, width = part.shape[-2:]
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    border = (left, side - width - left, top, side - height - top)
    square = functional.pad(part, border, value=background)[None]
    if side != size:
        square = functional.interpolate(square, (size, size), mode="bilinear", align_corners=False)
    return square[0]
