"""Errors that do not move with the person: texture that swims over the surface.

Images are ``[1, 3, H, W]``, RGB in [0, 1], masks ``[1, 1, H, W]`` of the person.
"""

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.metrics.image import person_box
from gsgan.metrics.regions import rectangle
from gsgan.utils.arrays import Bool, Bytes
from gsgan.utils.images import to_bytes

# Pixels: followed to the frame before and back, a pixel must end this near to its start.
FLOW_TOLERANCE = 1.0
# Pixels: OpenCV's flow fails on images with a shorter side.
MIN_FLOW_SIDE = 16
Values = NDArray[np.float32]


class Motion(NamedTuple):
    """The motion of the ground truth from the frame before.

    Args:
        places: ``[H, W, 2]`` x and y in the frame before of what each pixel shows; whole
            numbers are the centres of pixels.
        has_place: ``[H, W]`` the person's pixels whose place is known.
    """

    places: Values
    has_place: Bool


def truth_motion(
    target: Tensor, mask: Tensor, target_before: Tensor, mask_before: Tensor
) -> Motion:
    """The motion between two frames of one camera, by OpenCV's DIS optical flow.

    A pixel's place is known if the flow to the frame before and from there back ends
    within `FLOW_TOLERANCE` of its start, and if the person is at the pixel or at its
    place. None is known in images with a side shorter than `MIN_FLOW_SIDE`.

    Source: Kroeger et al. 2016, Fast Optical Flow using Dense Inverse Search.
    """
    # Without motion, each pixel is at its own place.
    height, width = mask.shape[-2:]
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    start = np.stack([columns, rows], axis=-1).astype(np.float32)
    box = person_box(torch.maximum(mask, mask_before))
    part = rectangle(box[0], minimum=MIN_FLOW_SIDE)
    if part is None or min(height, width) < MIN_FLOW_SIDE:
        return Motion(start, np.zeros((height, width), np.bool_))

    # The flow to the frame before and back, in the box around the person in both.
    grey = _grey(target, part)
    grey_before = _grey(target_before, part)
    # OpenCV's types require the flow to start from, which is optional.
    dis: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)  # that of the images
    back = np.zeros_like(start)
    forth = np.zeros_like(start)
    back[part] = dis.calc(grey, grey_before, None)
    forth[part] = dis.calc(grey_before, grey, None)

    # What one of the frames does not show does not return to its start.
    places = start + back
    missed = np.linalg.norm(back + _move(forth, places), axis=-1)
    there = _move(mask_before[0, 0].cpu().numpy(), places)
    person = np.maximum(mask[0, 0].cpu().numpy(), there) >= 0.5
    return Motion(places, person & (missed <= FLOW_TOLERANCE))


def warped_flicker(
    error: Tensor, error_before: Tensor, motion: Motion
) -> float:
    """Mean |e - e'| of the known pixels: e' is the error of the frame before, moved.

    It is 0 for an error that moves with the person, whatever its size.

    Args:
        error, error_before: ``[1, 3, H, W]`` image less ground truth.
        motion: from `truth_motion`.

    Returns:
        NaN if no pixel is known.
    """
    if not motion.has_place.any():
        return math.nan
    moved = _move(_as_array(error_before), motion.places)
    change = np.abs(_as_array(error) - moved).mean(axis=-1)
    return float(change[motion.has_place].mean())


def _grey(image: Tensor, part: tuple[slice, slice]) -> Bytes:
    """The grey values of some rows and columns of an image."""
    rows, columns = part
    colours = to_bytes(image[0, :, rows, columns])
    return np.asarray(cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY), np.uint8)


def _as_array(image: Tensor) -> Values:
    """``[H, W, 3]`` of an image, contiguous, as OpenCV needs it."""
    values = image[0].permute(1, 2, 0).contiguous()
    return values.float().cpu().numpy()


def _move(values: Values, places: Values) -> Values:
    """``[H, W]`` or ``[H, W, C]`` values at places, interpolated; the border's beyond it."""
    moved = cv2.remap(
        values,
        places[..., 0],
        places[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(moved, np.float32)
