"""A look at a few masks and labels before anything starts, and how much is looked at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsgan.data.checks import spans
from gsgan.data.files import read_grey
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_mask


@dataclass(frozen=True)
class Trust:
    """How many pictures are looked at, and what they must satisfy.

    Args:
        frames: compared with body and joints in every camera, evenly spaced; 0 looks at none.
            About 20 ms a picture of 1024 x 1024.
        min_box_iou: least overlap (IoU, median over those pictures) of the box of the projected
            body with the box of the mask; reading stops below.
        least_inside: share of a camera's joints inside its masks below which reading stops.
        min_inside: the same, below which a note names the camera.
        far_camera: times by which a camera may stand farther than the median one, or nearer;
            reading stops beyond, as its ``t`` is in another unit.
        joint_tolerance: metres that a joint may lie outside the mask and count as inside.
        max_beyond: share of a camera's masks beyond all joints above which a note names it.
        joint_reach: metres from the nearest joint at which a pixel of the mask is beyond them.
        watched_masks: masks of the first camera looked at, evenly spaced; 0 looks at none. About
            6 ms each at 1024 x 1024.
        mask_jump: share of the median by which a mask's area may differ without a note.
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


def spread(values: list[int], count: int) -> list[int]:
    """At most ``count`` of the values, evenly spaced."""
    if not values or count < 1:
        return []
    return sorted({values[round(i)] for i in np.linspace(0, len(values) - 1, count)})


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
