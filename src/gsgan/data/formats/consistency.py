"""Do cameras, joints and masks fit together? The rules, and the one set of thresholds.

Readers apply them to a few images when a dataset is opened (`check_consistency`, `watch_masks`);
`gsgan.check` applies the same measures and thresholds to many. Pixel centres lie at +0.5.
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
from gsgan.data.validation import spans
from gsgan.utils.arrays import evenly_spaced
from gsgan.utils.errors import DataError

Bytes = NDArray[np.uint8]
Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Box = tuple[float, float, float, float]
T = TypeVar("T")

LONGEST = 512  # pixels, longest side of a mask that joints are compared with
TOLERANCE = 1.5  # pixels of that mask that a joint may always lie outside
SAMPLED = 2000  # pixels of a mask whose distance to the joints is measured
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
    max_beyond: float = 0.1
    joint_reach: float = 0.3
    watched_masks: int = 48
    mask_jump: float = 0.5


class Comparison(NamedTuple):
    """One image's mask against what its camera should see.

    Args:
        camera, frame, mask, empty: of the image; the (first) file of its mask, and whether that
            has no foreground.
        iou: overlap of the boxes of mask and projected body; NaN when one of them is empty.
        inside, beyond: share of the visible joints inside the mask, and of the mask far from every
            visible joint; NaN of none.
    """

    camera: str
    frame: int
    mask: Path
    empty: bool
    iou: float
    inside: float
    beyond: float


def check_consistency(
    layout: Layout, body: Callable[[int], Float], limits: Consistency, hint: str
) -> list[str]:
    """Checks that the projected body lies where the masks are, and that not all masks are empty.

    Args:
        layout: the dataset.
        body: points on the body ``[N, 3]`` of a frame, metres, world.
        limits: how many frames, and the thresholds.
        hint: what to check when they do not fit.

    Returns:
        Notes on cameras whose joints lie outside their masks, or masks far from their joints.

    Raises:
        DataError: naming the camera that is furthest off, or the first empty mask.
    """
    compared = [
        _compare(layout, points, camera, frame, limits)
        for frame in spread(list(layout.frames), limits.frames)
        for points in [body(frame)]
        for camera, files in layout.masks.items()
        if frame in files
    ]
    if not compared:
        return []
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
    return _notes(layout.root, compared, limits, hint)


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
        beyond=mask_beyond(mask, camera, joints, limits.joint_reach),
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


def _notes(root: Path, compared: Sequence[Comparison], limits: Consistency, hint: str) -> list[str]:
    """One note on joints outside masks, one on masks beyond joints, where there are any."""
    notes = []
    inside, beyond = _means(compared, "inside"), _means(compared, "beyond")
    outside = {name for name, share in inside.items() if share < limits.min_inside}
    if outside:
        text = f"joints lie outside the masks (inside: {_listed(inside, outside)})"
        if min(inside.values()) < limits.least_inside:
            raise DataError(f"{root}: {text}; {hint}: python -m gsgan.check finds the wrong camera")
        notes.append(
            f"{text}: python -m gsgan.check finds whether calibration, skeleton or masks are wrong"
        )
    wide = {n for n, share in beyond.items() if share > limits.max_beyond and n not in outside}
    if wide:
        notes.append(
            f"masks reach more than {limits.joint_reach:g} m beyond all joints (share: "
            f"{_listed(beyond, wide)}): focal lengths are too short, masks show more than the "
            "person, or the skeleton lacks limbs: python -m gsgan.check reports more"
        )
    return notes


def _means(compared: Sequence[Comparison], field: str) -> dict[str, float]:
    """The mean of each camera's finite values."""
    kept: dict[str, list[float]] = {}
    for one in compared:
        if np.isfinite(value := getattr(one, field)):
            kept.setdefault(one.camera, []).append(value)
    return {name: float(np.mean(some)) for name, some in kept.items()}


def _listed(means: Mapping[str, float], named: set[str]) -> str:
    """The shares of the named cameras, and the mean of the others."""
    text = ", ".join(f"{name} {share:.0%}" for name, share in means.items() if name in named)
    rest = [share for name, share in means.items() if name not in named]
    return f"{text}; {np.mean(rest):.0%} in the other cameras" if rest else text


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
    small, pixels, depth, focal = _reduced(mask, camera, joints)
    outside = joint_distance(
        mask_distance(small), pixels, depth, np.ones(len(joints), bool), float(focal[0])
    )
    known = ~np.isnan(outside)
    allowed = np.maximum(tolerance, TOLERANCE * depth / focal[0])
    return float((outside <= allowed)[known].mean()) if known.any() else np.nan


def mask_beyond(mask: Bytes, camera: CameraEntry, joints: Float, reach: float) -> float:
    """Share of a stored mask further than ``reach`` metres from all world points ``[N, 3]``.

    Points behind the camera do not count; NaN without any, or of an empty mask. Evenly spaced
    pixels represent a large mask.
    """
    small, pixels, depth, focal = _reduced(mask, camera, joints)
    person, front = np.argwhere(small), depth > NEAR
    if len(person) == 0 or not front.any():
        return np.nan
    some = person[:: -(-len(person) // SAMPLED), ::-1] + 0.5
    metres = (some[:, None] - pixels[front]) / focal * depth[front, None]
    return float((np.linalg.norm(metres, axis=-1).min(axis=1) > reach).mean())


def _reduced(mask: Bytes, camera: CameraEntry, points: Float) -> tuple[Bool, Float, Float, Float]:
    """The mask of at most `LONGEST` pixels; pixels ``[N, 2]``, depths ``[N]``, focal ``[2]``."""
    step = max(1, -(-max(mask.shape) // LONGEST))
    pixels, depth = camera.stored_pixels(points) / step, project(camera, points)[1]
    return np.asarray(mask[::step, ::step] > 127), pixels, depth, np.diag(camera.K)[:2] / step


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


def watch_masks(layout: Layout, limits: Consistency) -> list[str]:
    """Notes on the frames at which the first camera's mask is empty or of an unusual area."""
    camera = next((name for name, files in layout.masks.items() if files), None)
    if camera is None or limits.watched_masks == 0:
        return []
    frames = spread(sorted(layout.masks[camera]), limits.watched_masks)
    masks = (read_mask(layout.mask_files(camera, f), layout.pixels) for f in frames)
    filled, areas = np.array([(mask.any(), np.count_nonzero(mask > 127)) for mask in masks]).T
    filled = filled > 0
    usual = float(np.median(areas[filled])) if filled.any() else 0.0
    odd = filled & (np.abs(areas - usual) > limits.mask_jump * usual)
    off = f"mask's area is more than {limits.mask_jump:.0%} off the usual"
    return [
        f"camera {camera}: the {case} at frames {spans(np.array(frames)[at].tolist())} of "
        f"{len(frames)} compared; leave bad ones out with data.reader.drop_frames"
        for case, at in (("mask is empty", ~filled), (off, odd))
        if at.any()
    ]
