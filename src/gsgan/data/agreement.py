"""Do masks and projected joints belong together? How far each lies from the other.

Pure functions of arrays. Pixels have their centres at +0.5.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.crop import NEAR

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

LOOKED_AT = 2000  # pixels of a mask whose distance from the joints is found
FAR_PIXELS = 1e4  # drawing coordinates are held within this: OpenCV's are 16 bit when shifted


def mask_distance(mask: Bool) -> Float:
    """``[H, W]`` pixels from every pixel to the mask; 0 in it, infinite when it is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf)
    outside = (~mask).astype(np.uint8)
    return cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)


def joint_distance(
    distance: Float, pixels: Float, depth: Float, judged: Bool, focal: float
) -> Float:
    """``[J]`` metres by which joints lie outside the mask; NaN where they cannot be judged.

    Args:
        distance: ``[H, W]`` of `mask_distance`.
        pixels: ``[J, 2]`` of the joints in that picture.
        depth: ``[J]`` metres.
        judged: ``[J]`` which joints were seen; those behind the camera or off the picture are left
            out as well.
        focal: pixels, of that picture.
    """
    known = np.where(np.isfinite(pixels), pixels, -1.0).clip(-1, FAR_PIXELS)
    column, row = np.floor(known.T).astype(int)
    height, width = distance.shape
    judged = judged & (depth > NEAR) & (column >= 0) & (column < width) & (row >= 0)
    judged &= row < height
    metres = np.full(len(pixels), np.nan)
    metres[judged] = distance[row[judged], column[judged]] * depth[judged] / focal
    return metres


def beyond_share(mask: Bool, pixels: Float, depth: Float, focal: Float, reach: float) -> float:
    """Share of a mask that lies further than ``reach`` metres from every joint; NaN of nothing.

    Args:
        mask: ``[H, W]``; of a large one evenly spread pixels stand for all.
        pixels: ``[J, 2]`` of the joints in that picture, or beside it.
        depth: ``[J]`` metres; joints behind the camera are left out.
        focal: ``[2]`` pixels along x and y, of that picture.
        reach: metres.
    """
    person, joints = np.argwhere(mask), depth > NEAR
    if len(person) == 0 or not joints.any():
        return np.nan
    some = person[:: -(-len(person) // LOOKED_AT), ::-1] + 0.5
    metres = (some[:, None] - pixels[joints]) / focal * depth[joints, None]
    return float((np.linalg.norm(metres, axis=-1).min(axis=1) > reach).mean())
