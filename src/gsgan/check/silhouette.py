"""The silhouette that a skeleton suggests, and how two silhouettes compare.

Pure functions of arrays. Pixel centres lie at +0.5.
"""

from __future__ import annotations

import cv2
import numpy as np

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import NEAR, project
from gsgan.data.formats.trust import FAR_PIXELS, Bool, Float
from gsgan.skeleton.template import SkeletonTemplate

FLESH = 0.07  # metres of body about every bone: between an arm and a thigh
HEAD_RADIUS = 0.12  # metres about the middle of the face: half of a head's height


def body_silhouette(
    camera: CameraEntry, p: Float, visible: Bool, template: SkeletonTemplate
) -> Bool:
    """``[H, W]`` silhouette estimated from a skeleton: thick bones, a filled trunk, a round head.

    Joints ``p [J, 3]`` (metres) behind the camera are left out, and so is lens distortion.
    """
    size = camera.size
    pixels, depth = project(camera, p)
    canvas = np.zeros(size, np.uint8)
    drawn = visible & (depth > NEAR)
    at = np.round(np.clip(np.nan_to_num(pixels), -FAR_PIXELS, FAR_PIXELS) - 0.5).astype(np.int32)
    metre = abs(camera.K[0, 0]) / np.maximum(depth, NEAR)  # pixels
    trunk = template.torso
    edges = [*template.limbs, *zip(trunk, (trunk[1], trunk[3], trunk[0], trunk[2]), strict=True)]
    for a, b in edges:
        if drawn[a] and drawn[b]:
            width = thickness(2 * FLESH * min(metre[a], metre[b]), size)
            cv2.line(canvas, at[a].tolist(), at[b].tolist(), 1, width)
    corners = [j for j in trunk if drawn[j]]
    if len(corners) > 2:
        cv2.fillConvexPoly(canvas, cv2.convexHull(at[corners]), 1)
    face = [j for j in template.face if drawn[j]]
    if face:
        middle = at[face].mean(0).round().astype(int)
        radius = thickness(HEAD_RADIUS * float(metre[face].mean()), size)
        cv2.circle(canvas, middle.tolist(), radius, 1, -1)
    return canvas > 0


def thickness(pixels: float, size: tuple[int, int]) -> int:
    """A whole line width that OpenCV can draw: at least 1, at most the image."""
    return int(np.clip(round(float(pixels)), 1, min(255, max(size))))


def overlap(a: Bool, b: Bool) -> float:
    """Intersection over union; 0 when both are empty."""
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 0.0


def best_shift(mask: Bool, body: Bool) -> tuple[int, int]:
    """Whole pixels ``(dx, dy)`` by which the mask lies beside the body: largest correlation."""
    height, width = mask.shape
    shape = (2 * height, 2 * width)  # padded: a shift must not wrap around
    spectrum = np.fft.rfft2(mask, shape) * np.conj(np.fft.rfft2(body, shape))
    common = np.fft.irfft2(spectrum, shape)
    dy, dx = np.unravel_index(int(np.argmax(common)), shape)
    return int((dx + width) % (2 * width) - width), int((dy + height) % (2 * height) - height)


def moved(mask: Bool, dx: int, dy: int) -> Bool:
    """A mask moved by whole pixels, empty where nothing was."""
    shift = np.array([[1, 0, dx], [0, 1, dy]], np.float64)
    return cv2.warpAffine(mask.astype(np.uint8), shift, mask.shape[::-1], flags=0) > 0
