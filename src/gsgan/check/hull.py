"""The visual hull: whether the masks agree among themselves, whatever the skeleton says.

Space is carved by all masks of one moment; where cameras and masks agree, what is left fills every
mask. Leaving one camera out names the one that carves off what the others show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.check.findings import Finding
from gsgan.check.looking import Look
from gsgan.check.settings import Limits, Sampling
from gsgan.check.silhouette import FAR_PIXELS, Bool, Float, thickness
from gsgan.check.subject import Subject, evenly
from gsgan.data.crop import NEAR, project

AIR = 0.35  # metres of space round the joints that is carved
LEAST_CAMERAS = 3  # with two, either may be the wrong one


@dataclass(frozen=True)
class Carving:
    """The voxels of one moment that at most one camera carves off.

    Args:
        looks: ``C`` of them.
        inside: ``[C, V]`` in the mask, or not in the picture at all.
        judged: ``[C]`` masks ``[h, w]``, as far as they lie before the carved space.
        pixels: ``[C, V, 2]`` whole pixels in the small masks, -1 where off the picture.
        depth: ``[C, V]`` metres.
        grown: ``[C]`` pixels that a voxel covers.
        edge: metres, of a voxel.
    """

    looks: tuple[Look, ...]
    inside: Bool
    judged: tuple[Bool, ...]
    pixels: NDArray[np.int64]
    depth: Float
    grown: tuple[int, ...]
    edge: float

    @property
    def hull(self) -> Bool:
        """``[V]`` what no camera carves off."""
        return np.asarray(self.inside.all(0))


def carvings(subject: Subject, looks: Sequence[Look], sampling: Sampling) -> list[Carving]:
    """Carves the moments that most cameras saw, evenly spread over time."""
    moments: dict[int, list[Look]] = {}
    for look in looks:
        moments.setdefault(look.frame, []).append(look)
    most = max((len(seen) for seen in moments.values()), default=0)
    if most < 2:
        return []
    full = tuple(sorted(frame for frame, seen in moments.items() if len(seen) == most))
    chosen = evenly(full, sampling.hull_frames)
    return [carve(subject, moments[frame], sampling.hull_voxel) for frame in chosen]


def carve(subject: Subject, looks: Sequence[Look], edge: float) -> Carving:
    """Asks every camera of a moment about a grid of voxels round the skeleton.

    Args:
        subject: the capture.
        looks: of one frame.
        edge: metres, of a voxel.
    """
    row = subject.rows[looks[0].frame]
    joints = subject.p[row][subject.visible[row]]
    low, high = joints.min(0) - AIR, joints.max(0) + AIR
    axes = [np.arange(a, b, edge) + edge / 2 for a, b in zip(low, high, strict=True)]
    voxels = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    views = [_seen(subject, look, voxels) for look in looks]
    inside = np.stack([view[0] for view in views])
    kept = (~inside).sum(0) <= 1
    return Carving(
        looks=tuple(looks),
        inside=inside[:, kept],
        judged=tuple(look.mask & _before(subject, look, low, high) for look in looks),
        pixels=np.stack([view[1][kept] for view in views]),
        depth=np.stack([view[2][kept] for view in views]),
        grown=tuple(_grown(subject, look, edge) for look in looks),
        edge=edge,
    )


def _seen(subject: Subject, look: Look, voxels: Float) -> tuple[Bool, NDArray[np.int64], Float]:
    entry = subject.cameras[look.camera]
    raw, depth = project(entry, voxels)
    height, width = entry.size
    seen = (depth > NEAR) & (raw >= 0).all(1) & (raw[:, 0] < width) & (raw[:, 1] < height)
    limit = np.array(look.mask.shape[::-1]) - 1
    pixels = np.floor(look.place(raw)).clip(0, limit).astype(np.int64)
    inside = look.mask[pixels[:, 1], pixels[:, 0]] | ~seen
    return inside, np.where(seen[:, None], pixels, -1), depth


def _before(subject: Subject, look: Look, low: Float, high: Float) -> Bool:
    """``[h, w]`` where the small picture shows the box; everywhere when the camera is in it."""
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3)
    raw, depth = project(subject.cameras[look.camera], corners)
    if (depth < NEAR).any():
        return np.ones(look.mask.shape, bool)
    at = np.clip(look.place(raw), -FAR_PIXELS, FAR_PIXELS).round().astype(np.int32)
    canvas = cv2.fillConvexPoly(np.zeros(look.mask.shape, np.uint8), cv2.convexHull(at), 1)
    return np.asarray(canvas > 0)


def _grown(subject: Subject, look: Look, edge: float) -> int:
    """Pixels that a voxel at the person covers, corner to corner, and one more."""
    entry, row = subject.cameras[look.camera], subject.rows[look.frame]
    depth = max(NEAR, float(project(entry, subject.p[row])[1].mean()))
    focal = float(entry.K[0, 0] * look.place.scale[0])
    return thickness(1 + np.sqrt(2) * edge * focal / depth, look.mask.shape)


def filled(carving: Carving, kept: Bool) -> Float:
    """``[C]`` share of each camera's mask that the kept voxels ``[V]`` cover; NaN when empty."""
    shares = np.full(len(carving.looks), np.nan)
    for i, judged in enumerate(carving.judged):
        total = np.count_nonzero(judged)
        if total:
            canvas = np.zeros(judged.shape, np.uint8)
            at = carving.pixels[i][kept & (carving.pixels[i, :, 0] >= 0)]
            canvas[at[:, 1], at[:, 0]] = 1
            grown = cv2.dilate(canvas, np.ones((carving.grown[i],) * 2, np.uint8)) > 0
            shares[i] = np.count_nonzero(grown & judged) / total
    return shares


@dataclass(frozen=True)
class HullScore:
    """How well the masks agree.

    Args:
        filled: share of the mask that the hull fills, by camera.
        without: mean share in the other cameras once this one does not carve, by camera.
    """

    filled: dict[str, float]
    without: dict[str, float]


def score_hulls(carved: Sequence[Carving]) -> HullScore | None:
    """Means over the carved moments; None when fewer than three cameras saw one together."""
    if not carved or len(carved[0].looks) < LEAST_CAMERAS:
        return None
    whole: dict[str, list[float]] = {}
    spared: dict[str, list[float]] = {}
    for carving in carved:
        shares = filled(carving, carving.hull)
        for i, look in enumerate(carving.looks):
            whole.setdefault(look.camera, []).append(shares[i])
            # a voxel is kept here when no camera but this one carves it off
            kept = np.asarray(np.delete(carving.inside, i, axis=0).all(0))
            without = filled(carving, kept)
            spared.setdefault(look.camera, []).append(float(np.nanmean(np.delete(without, i))))
    return HullScore(
        {name: float(np.mean(values)) for name, values in whole.items()},
        {name: float(np.mean(values)) for name, values in spared.items()},
    )


def judge_hulls(
    score: HullScore | None, limits: Limits, blamed: frozenset[str] = frozenset()
) -> list[Finding]:
    """Says whose masks or calibration do not fit the others'.

    Args:
        score: of `score_hulls`.
        limits: what is too little.
        blamed: cameras known to be wrong, which explains it.
    """
    if score is None or blamed:
        return []
    low = [name for name, share in score.filled.items() if not share >= limits.hull_warning]
    if not low:
        return []
    mean = float(np.nanmean(list(score.filled.values())))
    culprit = max(score.without, key=lambda name: score.without[name])
    gain = score.without[culprit] - mean
    text = f"the masks do not agree: together they fill {mean:.0%} of themselves"
    if gain > limits.hull_gain:
        text += (
            f", and {score.without[culprit]:.0%} without camera {culprit}; its masks or its "
            "calibration do not fit the other cameras"
        )
    else:
        text += (
            f" (least: {min(score.filled, key=lambda n: score.filled[n])}); look at the overlays"
        )
    return [Finding("warning", "masks", text)]
