"""Texture in images: what optical flow can follow."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.utils.arrays import Bytes

# pixels: side of the squares whose gradients are looked at
SIDE = 17
# smaller eigenvalue of the structure tensor at which texture counts by half
TEXTURED = 8e-4


def grey(image: NDArray[Any]) -> Bytes:
    """Grey levels ``[h, w]`` of RGB ``[h, w, 3]`` in [0, 1]."""
    levels = (image.clip(0, 1) * 255).round().astype(np.uint8)
    return np.asarray(cv2.cvtColor(levels, cv2.COLOR_RGB2GRAY), np.uint8)


def texture(levels: Bytes) -> NDArray[Any]:
    """``[h, w]`` in [0, 1]: how well grey levels tell where each pixel is, in both directions.

    Source: the smaller eigenvalue of the structure tensor (Shi and Tomasi, 1994).
    """
    eigenvalue = cv2.cornerMinEigenVal(levels.astype(np.float32) / 255, SIDE)
    return eigenvalue / (eigenvalue + TEXTURED)
