"""Whether the cameras agree with each other: their masks by the visual hull, their colours.

The visual hull is independent of the skeleton: space is carved by all masks of one moment; where
cameras and masks agree, the rest fills every mask. Leaving one camera out finds the one that carves
away what the others show.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.check.report import Finding, Table
from gsgan.check.settings import Limits
from gsgan.check.views import Subject, View, grouped, thickness
from gsgan.data.crop import NEAR, project
from gsgan.data.formats.consistency import FAR_PIXELS, Bool, Float, spread
from gsgan.data.scene_info import SceneInfo
from gsgan.effects import EffectSettings

AIR = 0.35  # metres of space about the joints that is carved
VOXEL = 0.04  # metres: about a pixel of the small masks
LEAST_CAMERAS = 3  # with two, either may be the wrong one
GAIN = 0.1  # in the share filled, that names the camera left out
CHANNELS = ("red", "green", "blue")
DARK = 0.05  # darker means give no ratio


def score_hulls(
    subject: Subject, views: Sequence[View], moments: int
) -> dict[str, tuple[float, float]]:
    """How well the masks agree, by camera; empty when fewer than three cameras see one moment.

    Means over at most ``moments`` frames that most cameras saw, evenly spaced: the share of the
    camera's mask that the hull fills, and the share in the others when this one does not carve.
    """
    by_frame: dict[int, list[View]] = {}
    for view in views:
        by_frame.setdefault(view.frame, []).append(view)
    most = max((len(seen) for seen in by_frame.values()), default=0)
    if most < LEAST_CAMERAS:
        return {}
    full = sorted(frame for frame, seen in by_frame.items() if len(seen) == most)
    found: dict[str, list[Float]] = {}
    for frame in spread(full, moments):
        for view, *shares in zip(by_frame[frame], *_shares(subject, by_frame[frame]), strict=True):
            found.setdefault(view.camera, []).append(np.array(shares))
    means = {name: np.mean(shares, axis=0) for name, shares in found.items()}
    return {name: (float(filled), float(without)) for name, (filled, without) in means.items()}


def _shares(subject: Subject, views: Sequence[View]) -> tuple[Float, Float]:
    """Of one moment, ``[C]`` each: the two shares of `score_hulls`."""
    row = subject.rows[views[0].frame]
    joints = subject.p[row][subject.visible[row]]
    low, high = joints.min(0) - AIR, joints.max(0) + AIR
    axes = [np.arange(a, b, VOXEL) + VOXEL / 2 for a, b in zip(low, high, strict=True)]
    voxels = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3)
    seen = [_carve(subject, view, voxels, corners) for view in views]
    inside = np.stack([kept for kept, *_ in seen])

    def filled(kept: Bool) -> Float:  # share of each mask that voxels cover; NaN when empty
        shares = np.full(len(views), np.nan)
        for i, (_, pixels, mask, side) in enumerate(seen):
            if mask.any():
                canvas = np.zeros(mask.shape, np.uint8)
                column, row = pixels[kept].T
                canvas[row[row >= 0], column[row >= 0]] = 1
                covered = cv2.dilate(canvas, np.ones((side, side), np.uint8)) > 0
                shares[i] = np.count_nonzero(covered & mask) / np.count_nonzero(mask)
        return shares

    spared = [
        float(np.nanmean(np.delete(filled(np.all(np.delete(inside, i, 0), 0)), i)))
        for i in range(len(views))
    ]
    return filled(np.all(inside, 0)), np.array(spared)


def _carve(
    subject: Subject, view: View, voxels: Float, corners: Float
) -> tuple[Bool, NDArray[np.int64], Bool, int]:
    """What one image keeps of the voxels ``[V, 3]`` in the box with these corners.

    Returns:
        ``[V]`` whether they lie in the mask or outside the image; their pixels, -1 outside the
        image; the mask where the image shows the box; pixels that a voxel covers.
    """
    entry = subject.cameras[view.camera]
    small = view.small(entry)
    raw, depth = project(entry, voxels)
    height, width = entry.size
    seen = (depth > NEAR) & (raw >= 0).all(1) & (raw[:, 0] < width) & (raw[:, 1] < height)
    limit = np.array(view.mask.shape[::-1]) - 1
    pixels = np.floor(project(small, voxels)[0]).clip(0, limit).astype(np.int64)
    inside = view.mask[pixels[:, 1], pixels[:, 0]] | ~seen
    at, depth = project(small, corners)
    mask = view.mask
    if (depth >= NEAR).all():  # else the camera is in the box
        at = np.clip(at, -FAR_PIXELS, FAR_PIXELS).round().astype(np.int32)
        shown = cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), cv2.convexHull(at), 1)
        mask = mask & (shown > 0)
    # corner to corner, at the person, plus one
    metres = max(NEAR, float(project(small, subject.p[subject.rows[view.frame]])[1].mean()))
    side = thickness(1 + np.sqrt(2) * VOXEL * small.K[0, 0] / metres, small.size)
    return inside, np.where(seen[:, None], pixels, -1), mask, side


def hull_findings(score: Mapping[str, tuple[float, float]], limits: Limits) -> list[Finding]:
    """Names the camera whose masks or calibration do not fit the others'."""
    filled = {name: share for name, (share, _) in score.items()}
    if all(share >= limits.hull_warning for share in filled.values()):
        return []
    mean = float(np.nanmean(list(filled.values())))
    name, (_, without) = max(score.items(), key=lambda item: item[1][1])
    text = f"the masks do not agree: together they fill {mean:.0%} of themselves"
    if without - mean > GAIN:
        text += f", and {without:.0%} without camera {name}: its masks or calibration do not fit"
    return [Finding("warning", "masks", text)]


def mean_colours(views: Sequence[View]) -> dict[str, tuple[Float, Float]]:
    """``[3]`` mean RGB of the person, and its ratio to the median camera's, by camera."""
    means = {
        name: np.asarray(sum(view.colour for view in own)) / sum(view.weight for view in own)
        for name, own in grouped(views).items()
        if sum(view.weight for view in own) > 0
    }
    middle = np.maximum(np.median(list(means.values()) or [np.ones(3)], axis=0), DARK)
    return {name: (mean, mean / middle) for name, mean in means.items()}


def differing(colours: Mapping[str, tuple[Float, Float]], limits: Limits) -> list[str]:
    """Cameras whose colour differs from the median camera's by more than the limit."""
    logs = {name: np.log(np.maximum(ratio, 1e-6)) for name, (_, ratio) in colours.items()}
    return [name for name, log in logs.items() if np.exp(np.abs(log).max()) > limits.colour_ratio]


def colour_findings(
    colours: Mapping[str, tuple[Float, Float]],
    info: SceneInfo | None,
    effects: EffectSettings,
    limits: Limits,
) -> list[Finding]:
    """Names the cameras whose colours differ.

    Cameras that agree on shared surface are not named: only the side that they see differs.
    ``info`` of the training split has that difference; None: unknown.
    """
    surface = None if info is None else info.surface
    agree = surface is not None and surface.difference < effects.colour_difference
    same = info.train_cameras if info is not None and agree else ()
    named = [name for name in differing(colours, limits) if name not in same]
    if not named or len(colours) < 2:
        return []
    ratios = {name: zip(CHANNELS, colours[name][1], strict=True) for name in named}
    text = "; ".join(
        f"{name} {', '.join(f'{channel} {value:.2f}' for channel, value in pairs)}"
        for name, pairs in ratios.items()
    )
    why = "seeing another side of the person does this as well"
    if surface is not None and not agree:
        why = f"on shared surface training cameras differ by {surface.difference:.3f}"
    text = (
        "cameras differ in exposure or white balance (times the median camera's mean colour of "
        f"the person): {text}; {why}. The table of effects shows whether training corrects it; "
        "effects.colour_correction=on always does"
    )
    return [Finding("warning", "colour", text)]


def colour_table(colours: Mapping[str, tuple[Float, Float]], limits: Limits) -> Table:
    """One row per camera."""
    rows = tuple(
        (name, *(" ".join(f"{v:.2f}" for v in values) for values in pair))
        for name, pair in colours.items()
    )
    named = differing(colours, limits)
    flagged = frozenset((i, 2) for i, row in enumerate(rows) if row[0] in named)
    return Table(("camera", "mean RGB of the person", "to the median camera"), rows, flagged)
