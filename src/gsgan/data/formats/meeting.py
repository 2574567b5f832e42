"""Do body, joints, cameras and masks belong together? Looked at before anything starts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsgan.data.agreement import beyond_share, joint_distance, mask_distance
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import NEAR, project
from gsgan.data.formats.trust import Trust, spread
from gsgan.data.layout import Layout
from gsgan.data.pixels import read_mask
from gsgan.utils.errors import DataError

Bytes = NDArray[np.uint8]
Float = NDArray[np.float64]
Box = tuple[float, float, float, float]

LOOKED_AT = 512  # pixels, longest side at which joints are held against a mask
TOLERANCE = 1.5  # pixels of that picture that a joint may always lie outside


@dataclass(frozen=True)
class Meeting:
    """One picture's mask against what its camera should see.

    Args:
        camera, frame: which one.
        mask: its (first) file.
        empty: the mask shows nobody.
        iou: overlap of the boxes of mask and projected body; None when one of them is empty.
        inside: share of the seen joints inside the mask; NaN of none.
        beyond: share of the mask far from every seen joint; NaN of none.
    """

    camera: str
    frame: int
    mask: Path
    empty: bool
    iou: float | None
    inside: float
    beyond: float


def check_meeting(
    layout: Layout, body: Callable[[int], Float], trust: Trust, hint: str
) -> list[str]:
    """The projected body must lie where the masks are, and not all of them may be empty.

    Args:
        layout: whose masks.
        body: points on the body ``[N, 3]`` of a frame, metres, world.
        trust: how many frames, and how well they must meet.
        hint: what to check when they do not.

    Returns:
        Notes on the cameras whose joints lie outside their masks, or masks far from their joints.

    Raises:
        DataError: naming the camera and frame that is furthest off, cameras with hardly a joint
            inside their masks or in another unit, or the first empty mask.
    """
    seen = meetings(layout, body, trust)
    check_far(layout, seen, trust)
    if seen and all(one.empty for one in seen):
        raise DataError(
            f"{seen[0].mask} shows no person, nor does any of the {len(seen)} masks looked at; "
            "expected values above 0 where the person is: check how the masks were written"
        )
    judged = [(one.iou, one) for one in seen if one.iou is not None]
    median = float(np.median([iou for iou, _ in judged])) if judged else 1.0
    if median < trust.min_box_iou:
        _, worst = min(judged, key=lambda pair: pair[0])
        raise DataError(
            f"{layout.root}: the projected body and the masks do not meet (their boxes overlap by "
            f"{median:.2f}, expected {trust.min_box_iou:g}; worst in camera {worst.camera}, frame "
            f"{worst.frame}: {worst.mask}); {hint}"
        )
    return judge_inside(layout.root, seen, trust, hint) + judge_beyond(seen, trust)


def meetings(layout: Layout, body: Callable[[int], Float], trust: Trust) -> list[Meeting]:
    """The same few moments in every camera that has them."""
    found = []
    for frame in spread(list(layout.frames), trust.frames):
        points, landmarks = body(frame), layout.landmarks.seen(frame)
        for name in (c for c, files in layout.masks.items() if frame in files):
            camera = layout.cameras[name]
            mask = read_mask(layout.mask_files(name, frame), layout.pixels)
            there, here = mask_box(mask), box_of(points, camera)
            met = None if there is None or here is None else box_iou(here, there)
            inside = inside_share(mask, camera, landmarks, trust.joint_tolerance)
            beyond = mask_beyond(mask, camera, landmarks, trust.joint_reach)
            path = layout.mask_path(name, frame)
            found.append(Meeting(name, frame, path, not mask.any(), met, inside, beyond))
    return found


def check_far(layout: Layout, seen: Sequence[Meeting], trust: Trust) -> None:
    """Cameras must stand about equally far from the person: those in another unit do not.

    Raises:
        DataError: naming the camera.
    """
    if not seen:
        return
    centre = np.median(layout.landmarks.seen(seen[0].frame), axis=0)
    metres = {n: float(np.linalg.norm(c.centre - centre)) for n, c in layout.cameras.items()}
    median = float(np.median(list(metres.values())))
    for name, distance in metres.items():
        if not median / trust.far_camera <= distance <= median * trust.far_camera:
            raise DataError(
                f"{layout.root}: camera {name} stands {distance:.3g} m from the person, the median "
                f"camera {median:.3g} m; its t is probably in another unit"
            )


def judge_inside(root: Path, seen: Sequence[Meeting], trust: Trust, hint: str) -> list[str]:
    """One note that names the cameras whose joints lie outside their masks, if there are any.

    Raises:
        DataError: naming those with hardly a joint inside.
    """
    means = by_camera((one.camera, one.inside) for one in seen)
    off = {name: share for name, share in means.items() if share < trust.min_inside}
    if not off:
        return []
    rest = [share for name, share in means.items() if name not in off]
    others = f"; {np.mean(rest):.0%} in the other cameras" if rest else ""
    text = ", ".join(f"{name} {share:.0%}" for name, share in off.items())
    told = f"joints lie outside the masks (inside: {text}{others})"
    if min(off.values()) < trust.least_inside:
        raise DataError(
            f"{root}: {told}; {hint}: python -m gsgan.check tells which of them is wrong"
        )
    return [f"{told}: python -m gsgan.check tells whether calibration, skeleton or masks are wrong"]


def judge_beyond(seen: Sequence[Meeting], trust: Trust) -> list[str]:
    """One note that names the cameras whose masks reach far beyond the joints, if there are any.

    Those whose joints lie outside their masks are named for that.
    """
    means = by_camera((one.camera, one.beyond) for one in seen)
    inside = by_camera((one.camera, one.inside) for one in seen)
    told = {name for name, share in inside.items() if share < trust.min_inside}
    off = {n: share for n, share in means.items() if share > trust.max_beyond and n not in told}
    if not off:
        return []
    rest = [share for name, share in means.items() if name not in off]
    others = f"; {np.mean(rest):.0%} in the other cameras" if rest else ""
    text = ", ".join(f"{name} {share:.0%}" for name, share in off.items())
    return [
        f"masks reach more than {trust.joint_reach:g} m beyond all joints ({text} of the mask"
        f"{others}): focal lengths that are too short do this, masks of more than the person, or a "
        "skeleton that lacks limbs: python -m gsgan.check tells more"
    ]


def by_camera(values: Iterable[tuple[str, float]]) -> dict[str, float]:
    """The mean of each camera's finite values."""
    kept: dict[str, list[float]] = {}
    for name, value in values:
        if np.isfinite(value):
            kept.setdefault(name, []).append(value)
    return {name: float(np.mean(some)) for name, some in kept.items()}


def mask_beyond(mask: Bytes, camera: CameraEntry, joints: Float, reach: float) -> float:
    """Share of a stored mask further than ``reach`` metres from all world points ``[N, 3]``."""
    step = max(1, -(-max(mask.shape) // LOOKED_AT))
    focal = np.diag(camera.K)[:2] / step
    pixels, depth = camera.stored_pixels(joints) / step, project(camera, joints)[1]
    return beyond_share(np.asarray(mask[::step, ::step] > 127), pixels, depth, focal, reach)


def inside_share(mask: Bytes, camera: CameraEntry, joints: Float, tolerance: float) -> float:
    """Share of world points ``[N, 3]`` in view that lie inside a stored mask; NaN of none.

    Args:
        mask: ``[H, W]``; an empty one gives NaN: it says nothing of the camera.
        camera: that saw it.
        joints: metres.
        tolerance: metres that they may lie outside.
    """
    if not mask.any():
        return np.nan
    step = max(1, -(-max(mask.shape) // LOOKED_AT))
    distance = mask_distance(np.asarray(mask[::step, ::step] > 127))
    depth = project(camera, joints)[1]
    focal = float(camera.K[0, 0]) / step
    pixels = camera.stored_pixels(joints) / step
    outside = joint_distance(distance, pixels, depth, np.ones(len(joints), bool), focal)
    judged = ~np.isnan(outside)
    allowed = np.maximum(tolerance, TOLERANCE * depth / focal)
    return float((outside <= allowed)[judged].mean()) if judged.any() else np.nan


def box_of(points: Float, camera: CameraEntry) -> Box | None:
    """(left, top, right, bottom) of world points ``[N, 3]`` in the stored (distorted) picture."""
    _, depth = project(camera, points)
    pixels = camera.stored_pixels(points[depth > NEAR])
    if len(pixels) == 0:
        return None
    height, width = camera.size
    (left, top), (right, bottom) = (
        np.clip(edge, 0, (width, height)) for edge in (pixels.min(0), pixels.max(0))
    )
    return float(left), float(top), float(right), float(bottom)


def mask_box(mask: Bytes) -> Box | None:
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
