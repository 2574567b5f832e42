"""A look at a few pictures before anything starts: do body, cameras and masks belong together?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry
from gsgan.data.checks import spans
from gsgan.data.crop import NEAR, project
from gsgan.data.files import read_grey
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_mask
from gsgan.errors import DataError

Float = NDArray[np.float64]
Box = tuple[float, float, float, float]

CAMERAS = 2  # in which a frame is compared: one may stand in line with an error


@dataclass(frozen=True)
class Trust:
    """How many pictures are looked at, and what they must satisfy.

    Args:
        frames: looked at, evenly spaced, each in two cameras; 0 looks at none.
        min_box_iou: least overlap (IoU, median over those) of the box of the projected body with
            the box of the mask.
        watched_masks: masks of the first camera looked at, evenly spaced; 0 looks at none. About
            6 ms each at 1024 x 1024.
        mask_jump: share of the median by which a mask's area may differ without a note.
    """

    frames: int = 3
    min_box_iou: float = 0.5
    watched_masks: int = 48
    mask_jump: float = 0.5


def spread(values: list[int], count: int) -> list[int]:
    """At most ``count`` of the values, evenly spaced."""
    if not values or count < 1:
        return []
    return sorted({values[round(i)] for i in np.linspace(0, len(values) - 1, count)})


def box_of(points: Float, camera: CameraEntry) -> Box | None:
    """(left, top, right, bottom) of world points ``[N, 3]`` in the stored (distorted) picture."""
    _, depth = project(camera, points)
    seen = points[depth > NEAR]
    if len(seen) == 0:
        return None
    rotation = cv2.Rodrigues(camera.R)[0]
    pixels = cv2.projectPoints(seen, rotation, camera.t, camera.K, camera.dist)[0][:, 0]
    height, width = camera.size
    (left, top), (right, bottom) = (
        np.clip(edge, 0, (width, height)) for edge in (pixels.min(0), pixels.max(0))
    )
    return float(left), float(top), float(right), float(bottom)


def mask_box(mask: NDArray[np.uint8]) -> Box | None:
    """The box of a mask's person, None when it is empty."""
    rows, columns = (np.flatnonzero((mask > 127).any(axis)) for axis in (1, 0))
    if len(rows) == 0:
        return None
    return float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1)


def box_iou(a: Box, b: Box) -> float:
    """Intersection over union of two boxes."""
    width = min(a[2], b[2]) - max(a[0], b[0])
    height = min(a[3], b[3]) - max(a[1], b[1])
    both = max(width, 0.0) * max(height, 0.0)
    total = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (a, b)) - both
    return both / total if total > 0 else 0.0


def check_boxes(layout: Layout, body: Callable[[int], Float], trust: Trust, hint: str) -> None:
    """The projected body must lie where the masks are, and not all of them may be empty.

    Args:
        layout: whose masks.
        body: points on the body ``[N, 3]`` of a frame, metres, world.
        trust: how many frames, and how well they must meet.
        hint: what to check when they do not.

    Raises:
        DataError: naming the camera and frame that is furthest off, or the first empty mask.
    """
    found: list[tuple[float, str, int]] = []
    empty: list[Path] = []
    looked = 0
    for frame in spread(list(layout.frames), trust.frames):
        points = body(frame)
        for name in [c for c, files in layout.masks.items() if frame in files][:CAMERAS]:
            mask = read_mask(layout.mask_files(name, frame), layout.pixels)
            there, here = mask_box(mask), box_of(points, layout.cameras[name])
            looked += 1
            if not mask.any():
                empty.append(layout.mask_path(name, frame))
            if there is not None and here is not None:
                found.append((box_iou(here, there), name, frame))
    if empty and len(empty) == looked:
        raise DataError(
            f"{empty[0]} shows no person, nor does any of the {looked} masks looked at; expected "
            "values above 0 where the person is: check how the masks were written"
        )
    if not found:
        return
    median = float(np.median([iou for iou, _, _ in found]))
    if median < trust.min_box_iou:
        _, name, frame = min(found)
        raise DataError(
            f"{layout.root}: the projected body and the masks do not meet (their boxes overlap by "
            f"{median:.2f}, expected {trust.min_box_iou:g}; worst in camera {name}, frame {frame}: "
            f"{layout.mask_path(name, frame)}); {hint}"
        )


def watch_masks(layout: Layout, trust: Trust) -> list[str]:
    """Notes on the frames at which the first camera's mask is empty or of an unusual area."""
    camera = next((name for name, files in layout.masks.items() if files), None)
    if camera is None or trust.watched_masks == 0:
        return []
    frames = spread(sorted(layout.masks[camera]), trust.watched_masks)
    masks = (read_mask(layout.mask_files(camera, f), layout.pixels) for f in frames)
    looked = [(mask.any(), np.count_nonzero(mask > 127)) for mask in masks]
    seen, areas = np.array([s for s, _ in looked]), np.array([n for _, n in looked], np.float64)
    usual = float(np.median(areas[seen])) if seen.any() else 0.0
    off = seen & (np.abs(areas - usual) > trust.mask_jump * usual)
    cases = {
        "mask is empty": ~seen,
        f"mask's area is more than {trust.mask_jump:.0%} off the usual": off,
    }
    odd = {
        case: [f for f, is_it in zip(frames, at, strict=True) if is_it]
        for case, at in cases.items()
    }
    return [
        f"camera {camera}: the {case} at frames {spans(at)} of {len(frames)} looked at; look at "
        "them, and leave bad ones out with data.reader.drop_frames"
        for case, at in odd.items()
        if at
    ]


def highest_label(root: Path, files: list[str]) -> int:
    """The highest value in some label pictures, 0 without any."""
    return max((int(read_grey(root / path).max()) for path in files), default=0)
