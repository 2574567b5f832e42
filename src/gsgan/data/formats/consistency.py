"""Do cameras, joints and masks fit together? The rules, and the one set of thresholds.

Readers apply them to a few images when a dataset is opened (`check_consistency`); `gsgan.check`
applies the same measures and thresholds to many. Pixel centres lie at +0.5.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import NEAR, project
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_mask
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.errors import DataError

Bytes = NDArray[np.uint8]
Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Box = tuple[float, float, float, float]
T = TypeVar("T")

LONGEST = 512  # pixels, longest side of a mask that joints are compared with
TOLERANCE = 1.5  # pixels of that mask that a joint may always lie outside
FAR_PIXELS = 1e4  # drawing coordinates are clipped to this: OpenCV's are 16 bit when shifted


@dataclass(frozen=True)
class Consistency:
    """How many images are compared when a dataset is opened, and the thresholds.

    conf/data/capture.yaml explains every field.
    """

    frames: int = 3
    min_box_iou: float = 0.5
    least_inside: float = 0.2
    min_inside: float = 0.9
    far_camera: float = 10.0
    joint_tolerance: float = 0.05


class Comparison(NamedTuple):
    """One image's mask against what its camera should see.

    Args:
        camera, frame, mask, empty: of the image; the (first) file of its mask, and whether that
            has no foreground.
        iou: overlap of the boxes of mask and projected body; NaN when one of them is empty.
        inside: share of the visible joints inside the mask; NaN of none.
    """

    camera: str
    frame: int
    mask: Path
    empty: bool
    iou: float
    inside: float


def check_consistency(
    layout: Layout, body: Callable[[int], Float], limits: Consistency, hint: str
) -> None:
    """Checks that the projected body and the joints lie where the masks are.

    Args:
        layout: the dataset.
        body: points on the body ``[N, 3]`` of a frame, metres, world.
        limits: how many frames, and the thresholds.
        hint: what to check when they do not fit.

    Raises:
        DataError: naming the camera that is furthest off, or the first of masks that are all empty.
    """
    compared = [
        _compare(layout, points, camera, frame, limits)
        for frame in spread(list(layout.frames), limits.frames)
        for points in [body(frame)]
        for camera, files in layout.masks.items()
        if frame in files
    ]
    if not compared:
        return
    person = np.median(layout.landmarks.seen(compared[0].frame), axis=0)
    metres = {n: float(np.linalg.norm(c.centre - person)) for n, c in layout.cameras.items()}
    if far := far_cameras(metres, limits.far_camera):
        raise DataError(f"{layout.root}: {next(iter(far.values()))}")
    if all(one.empty for one in compared):
        raise DataError(
            f"{compared[0].mask} shows no person, nor does any of the {len(compared)} masks "
            "compared; expected values above 0 where the person is"
        )
    known = [one for one in compared if np.isfinite(one.iou)]
    if known and (median := float(np.median([one.iou for one in known]))) < limits.min_box_iou:
        worst = min(known, key=lambda one: one.iou)
        raise DataError(
            f"{layout.root}: the projected body and the masks do not meet (their boxes overlap by "
            f"{median:.2f}, expected {limits.min_box_iou:g}; worst in camera {worst.camera}, frame "
            f"{worst.frame}: {worst.mask}); {hint}"
        )
    inside = {
        name: np.mean(shares)
        for name in layout.cameras
        if (shares := [x.inside for x in compared if x.camera == name and np.isfinite(x.inside)])
    }
    if inside and min(inside.values()) < limits.least_inside:
        found = ", ".join(f"{name} {share:.0%}" for name, share in inside.items())
        raise DataError(
            f"{layout.root}: joints lie outside the masks (inside: {found}); {hint}: "
            "python -m gsgan.check finds the wrong camera"
        )


def _compare(
    layout: Layout, points: Float, name: str, frame: int, limits: Consistency
) -> Comparison:
    camera, joints = layout.cameras[name], layout.landmarks.seen(frame)
    mask = read_mask(layout.mask_files(name, frame), layout.pixels)
    expected, found = box_of(points, camera), mask_box(mask)
    return Comparison(
        camera=name,
        frame=frame,
        mask=layout.mask_path(name, frame),
        empty=not mask.any(),
        iou=box_iou(expected, found) if expected and found else np.nan,
        inside=inside_share(mask, camera, joints, limits.joint_tolerance),
    )


def far_cameras(metres: Mapping[str, float], factor: float) -> dict[str, str]:
    """A message for each camera that is ``factor`` times farther than the median one, or nearer."""
    median = float(np.median(list(metres.values())))
    return {
        name: f"camera {name} stands {distance:.3g} m from the person, the median camera "
        f"{median:.3g} m; its t is probably in another unit"
        for name, distance in metres.items()
        if not median / factor <= distance <= median * factor
    }


def mask_distance(mask: Bool) -> Float:
    """``[H, W]`` pixels from every pixel to the mask; 0 in it, infinite when it is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf)
    outside = (~mask).astype(np.uint8)
    return cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)


def joint_distance(
    distance: Float, pixels: Float, depth: Float, visible: Bool, focal: float
) -> Float:
    """``[J]`` metres by which joints lie outside the mask; NaN where unknown.

    Unknown are joints that are not ``visible [J]``, behind the camera, or outside the image.

    Args:
        distance: ``[H, W]`` of `mask_distance`.
        pixels, depth: ``[J, 2]`` and ``[J]`` (metres) of the joints in that image.
        focal: pixels, of that image.
    """
    known = np.where(np.isfinite(pixels), pixels, -1.0).clip(-1, FAR_PIXELS)
    column, row = np.floor(known.T).astype(int)
    height, width = distance.shape
    usable = visible & (depth > NEAR)
    usable &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
    metres = np.full(len(pixels), np.nan)
    metres[usable] = distance[row[usable], column[usable]] * depth[usable] / focal
    return metres


def inside_share(mask: Bytes, camera: CameraEntry, joints: Float, tolerance: float) -> float:
    """Share of world points ``[N, 3]`` in view that lie inside a stored mask ``[H, W]``.

    They may lie ``tolerance`` metres outside; NaN of no points, or of an empty mask.
    """
    if not mask.any():
        return np.nan
    step = max(1, -(-max(mask.shape) // LONGEST))
    small, focal = mask[::step, ::step] > 127, float(camera.K[0, 0]) / step
    pixels, depth = camera.stored_pixels(joints) / step, project(camera, joints)[1]
    everyone = np.ones(len(joints), bool)
    outside = joint_distance(mask_distance(small), pixels, depth, everyone, focal)
    known = ~np.isnan(outside)
    allowed = np.maximum(tolerance, TOLERANCE * depth / focal)
    return float((outside <= allowed)[known].mean()) if known.any() else np.nan


def box_of(points: Float, camera: CameraEntry) -> Box | None:
    """(left, top, right, bottom) of world points ``[N, 3]`` in the stored (distorted) image."""
    _, depth = project(camera, points)
    pixels = camera.stored_pixels(points[depth > NEAR])
    if len(pixels) == 0:
        return None
    edges = np.clip([pixels.min(0), pixels.max(0)], 0, camera.size[::-1])
    (left, top), (right, bottom) = edges.tolist()
    return left, top, right, bottom


def mask_box(mask: Bytes) -> Box | None:
    """The box of a mask's person, None when it is empty."""
    left, top, width, height = cv2.boundingRect((mask > 127).astype(np.uint8))
    return (left, top, left + width, top + height) if width else None


def box_iou(a: Box, b: Box) -> float:
    """Intersection over union of two boxes."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    both = max(width, 0.0) * max(height, 0.0)
    total = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (a, b)) - both
    return both / total if total > 0 else 0.0


def spread(values: Sequence[T], count: int) -> list[T]:
    """At most ``count`` of the values, evenly spaced, first and last included."""
    return [values[i] for i in evenly_spaced(len(values), count, ends=True)]
