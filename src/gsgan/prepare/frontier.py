"""What silhouettes say about cameras: points where epipolar lines touch them in two images.

A plane through two cameras' centres that touches the person touches both silhouettes: the point of
contact is seen on both outlines (a frontier point; Cipolla and Giblin, *Visual Motion of Curves and
Surfaces*). So each frame of each pair of cameras has two points that correspond, without any
detector of landmarks, and masks that are too wide or too narrow move both to opposite sides.
"""

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import NamedTuple

import cv2
import numpy as np

from gsgan.data.cameras import CameraEntry
from gsgan.prepare.camera_array import CameraArray, undistort_points
from gsgan.utils.arrays import Bool, Bytes, Float, Ints

BORDER = 3  # pixels: an outline so near to the border goes on beyond it
MIN_AREA = 400  # pixels of a silhouette
INSIDE_LEVEL = 127  # of 255: larger values are the person


class Outline(NamedTuple):
    """The convex hull of a silhouette."""

    uv: Float  # [n, 2] undistorted pixels
    cut: Bool  # [n] whether the silhouette is cut off there by the border of the image


class Frontier(NamedTuple):
    """Points that two cameras see at the same place, in images of C cameras."""

    uv: Float  # [C, N, 2] undistorted pixels, NaN in all but two cameras
    # [C, N] distance of a camera's outline from the epipolar line, pixels; NaN elsewhere
    error: Float


def find_outlines(
    cameras: Sequence[CameraEntry],
    alphas: Mapping[str, Mapping[int, Bytes]],
    numbers: Mapping[str, Ints],
) -> list[list[Outline | None]]:
    """The outlines of each camera in each frame; None where there is no whole silhouette.

    Args:
        cameras: of the images, lens included.
        alphas: ``[H, W]`` 0..255 by camera and the camera's own frame number.
        numbers: ``[F]`` own frame numbers of each camera.
    """
    result = []
    for camera in cameras:
        by_number = alphas[camera.name]
        outlines: list[Outline | None] = []
        for number in numbers[camera.name].tolist():
            alpha = by_number.get(number)
            outlines.append(None if alpha is None else _outline(camera, alpha))
        result.append(outlines)
    return result


def _outline(camera: CameraEntry, mask: Bytes) -> Outline | None:
    """The hull of the largest piece of a mask ``[H, W]``."""
    pieces, _ = cv2.findContours(
        (mask > INSIDE_LEVEL).astype(np.uint8),
        cv2.RETR_EXTERNAL,
        cv2.CHAIN_APPROX_NONE,
    )
    largest = max(pieces, key=cv2.contourArea, default=None)
    if largest is None or cv2.contourArea(largest) < MIN_AREA:
        return None
    hull = cv2.convexHull(largest)[:, 0].astype(np.float64)
    size = np.array(mask.shape[::-1])
    cut = ((hull < BORDER) | (hull >= size - 1 - BORDER)).any(-1)

    # Contours have the centres of pixels, which are at +0.5.
    return Outline(undistort_points(camera, hull + 0.5), np.asarray(cut))


def frontier_points(
    cameras: CameraArray, outlines: Sequence[Sequence[Outline | None]]
) -> Frontier:
    """The frontier points of all pairs of cameras in all frames."""
    C = len(cameras)
    points = []
    errors = []
    for i, j in permutations(range(C), 2):
        F = _fundamental(cameras, i, j)
        epipole = _epipole(cameras, i, j)
        for one, other in zip(outlines[i], outlines[j], strict=True):
            if one is None or other is None:
                continue
            for k in _tangents(one, epipole):
                match = _touching(F @ np.append(one.uv[k], 1.0), other)
                if match is None:
                    continue
                at, error = match
                uv = np.full((C, 2), np.nan)
                uv[i] = one.uv[k]
                uv[j] = other.uv[at]
                points.append(uv)
                errors.append(np.full(C, np.nan))
                errors[-1][j] = error
    if not points:
        return Frontier(np.zeros((C, 0, 2)), np.zeros((C, 0)))
    return Frontier(np.stack(points, axis=1), np.stack(errors, axis=1))


def _fundamental(cameras: CameraArray, i: int, j: int) -> Float:
    """The matrix ``[3, 3]`` from pixels of camera i to epipolar lines of camera j."""
    R = cameras.R[j] @ cameras.R[i].T
    x, y, z = cameras.t[j] - R @ cameras.t[i]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(
        np.linalg.inv(cameras.K[j]).T @ cross @ R @ np.linalg.inv(cameras.K[i])
    )


def _epipole(cameras: CameraArray, i: int, j: int) -> Float:
    """The other camera's centre ``[3]`` in the image of camera i, homogeneous."""
    x = cameras.R[i] @ cameras.centres[j] + cameras.t[i]
    return np.asarray(cameras.K[i] @ x)


def _tangents(outline: Outline, epipole: Float) -> list[int]:
    """The points of an outline where lines through the epipole touch it; none if it is inside."""
    # A line touches the outline if all of it lies on one side.
    points = np.c_[outline.uv, np.ones(len(outline.uv))]
    lines = np.cross(points, epipole)
    side = lines @ points.T
    scale = 1e-9 * np.abs(side).max()
    touches = (side <= scale).all(1) | (side >= -scale).all(1)
    return [int(k) for k in np.flatnonzero(touches & ~outline.cut)]


def _touching(line: Float, outline: Outline) -> tuple[int, float] | None:
    """The point of an outline that a line nearly touches, and its distance in pixels."""
    distance = (outline.uv @ line[:2] + line[2]) / np.linalg.norm(line[:2])
    ends = [int(distance.argmin()), int(distance.argmax())]
    at = min(ends, key=lambda k: abs(distance[k]))
    if outline.cut[at]:
        return None
    return at, float(abs(distance[at]))
