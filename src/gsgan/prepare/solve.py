"""From 2D detections to 3D joints and better camera poses, with the error after every stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.data.joints import ALL, BODY, flip_groups
from gsgan.prepare.cleanse import Cleansing, cleanse
from gsgan.prepare.flips import FlipSearch, apply_flips, find_flips
from gsgan.prepare.refine import Refinement, refine_rig
from gsgan.prepare.rig import FOCAL, Bool, Float, Rig
from gsgan.prepare.smooth import Smoothing, smooth
from gsgan.prepare.triangulate import Points, Triangulation

FIELDS = ("p", "conf", "views", "error", "uv", "flips")  # of a solution, kept as they are
Say = Callable[[str], None]


@dataclass(frozen=True)
class Settings:
    """The settings of every stage."""

    triangulation: Triangulation = field(default_factory=Triangulation)
    flips: FlipSearch = field(default_factory=FlipSearch)
    refinement: Refinement = field(default_factory=Refinement)
    cleansing: Cleansing = field(default_factory=Cleansing)
    smoothing: Smoothing = field(default_factory=Smoothing)


@dataclass(frozen=True)
class Solution:
    """What was found.

    Args:
        rig: refined.
        p: ``[F, J, 3]`` metres, NaN = missing.
        conf: ``[F, J]`` mean confidence of the cameras that see the joint, 0 where missing.
        views: ``[F, J]`` cameras whose detection lies within the triangulation's ``scale``.
        error: ``[C, F, J]`` final reprojection error, full-size undistorted pixels, NaN = not seen.
        uv: ``[C, F, J, 2]`` undistorted detections with the sides put right.
        flips: ``[C, F, G]`` sides that were swapped.
        stages: name of each stage and its body errors ``[C, F, 33]``.
        removed: joints taken out, by reason.
    """

    rig: Rig
    p: Float
    conf: Float
    views: NDArray[np.int64]
    error: Float
    uv: Float
    flips: Bool
    stages: dict[str, Float]
    removed: dict[str, int]

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """All of it as plain arrays, but for K."""
        return {
            **{name: getattr(self, name) for name in FIELDS},
            "R": self.rig.R,
            "t": self.rig.t,
            "stage_names": np.array(list(self.stages)),
            "stages": np.stack(list(self.stages.values())),
            "reasons": np.array(list(self.removed)),
            "removed": np.array(list(self.removed.values())),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], K: Float) -> Solution:
        """The inverse of `to_arrays`."""
        return cls(
            rig=Rig(K, arrays["R"], arrays["t"]),
            stages=dict(zip(arrays["stage_names"].tolist(), arrays["stages"], strict=True)),
            removed=dict(zip(arrays["reasons"].tolist(), arrays["removed"].tolist(), strict=True)),
            **{name: arrays[name] for name in FIELDS},
        )


def solve(
    rig: Rig, time: Float, uv: Float, conf: Float, settings: Settings, say: Say = lambda _: None
) -> Solution:
    """All stages: plain, robust, flips, refined, smoothed.

    Args:
        rig: as calibrated.
        time: ``[F]`` seconds.
        uv: ``[C, F, J, 2]`` undistorted pixels, NaN = not seen; J is 33, or 75 with hands.
        conf: ``[C, F, J]`` 0 = not seen.
        settings: of every stage.
        say: is told what begins.
    """
    triangulation, J, K, pixels = settings.triangulation, uv.shape[2], rig.K, uv
    to_pixels = (rig.focal / FOCAL)[:, None, None]
    rig, uv = rig.normalised(uv)
    given = rig
    conf = np.where(conf > triangulation.min_confidence, conf, 0.0)
    groups, stages = flip_groups(hands=J == ALL), dict[str, Float]()
    say("triangulating")
    plain = triangulation.plain(rig, _flat(uv), _flat(conf))
    stages["plain"] = _body(rig.errors(plain, _flat(uv)), uv)
    points = triangulation.points(rig, _flat(uv), _flat(conf))
    stages["robust"] = _body(points.error, uv)
    flips = np.zeros((*conf.shape[:2], len(groups)), bool)
    sided, weight = uv, conf

    def put_right() -> Points:
        nonlocal flips, sided, weight
        if settings.flips.enabled:
            say("looking for swapped sides")
            flips = find_flips(rig, uv, conf, groups, settings.flips, triangulation)
            sided, weight = (apply_flips(v, flips, groups) for v in (uv, conf))
        return triangulation.points(rig, _flat(sided), _flat(weight))

    points = put_right()
    stages["flips"] = _body(points.error, uv)
    for _ in range(settings.refinement.rounds):
        say("refining the cameras")
        rig = _refined(given, rig, points, sided, weight, settings.refinement)
        points = put_right()
    stages["refined"] = _body(points.error, uv)
    p = points.p.reshape(-1, J, 3)
    p, removed = cleanse(p, settings.cleansing)
    trust = _mean_seen(points.weight.reshape(conf.shape), weight)
    p = smooth(p, trust, time, settings.smoothing.seconds)
    error = rig.errors(p.reshape(-1, 3), _flat(sided)).reshape(conf.shape)
    error = np.where(weight > 0, error, np.nan)
    stages["smoothed"] = error[:, :, :BODY]
    known = np.isfinite(p).all(-1)
    views = (np.nan_to_num(error, nan=np.inf) <= triangulation.scale).sum(0)
    conf3d = np.where(known, _mean_seen(weight, weight), 0.0)
    return Solution(
        rig=Rig(K, rig.R, rig.t),
        p=p,
        conf=conf3d,
        views=views,
        error=error * to_pixels,
        uv=apply_flips(pixels, flips, groups),
        flips=flips,
        stages={name: one * to_pixels for name, one in stages.items()},
        removed=removed,
    )


def _flat(values: Float) -> Float:
    return values.reshape(values.shape[0], -1, *values.shape[3:])


def _body(error: Float, uv: Float) -> Float:
    return error.reshape(uv.shape[:3])[:, :, :BODY]


def _refined(
    given: Rig, rig: Rig, points: Points, uv: Float, weight: Float, settings: Refinement
) -> Rig:
    """The rig refined on evenly spread frames and the body's joints: hands are less certain."""
    C, F, J = weight.shape
    count = min(F, settings.frames)
    chosen = np.unique(np.linspace(0, F - 1, count).round().astype(int))
    p = points.p.reshape(F, J, 3)[chosen, :BODY].reshape(-1, 3)
    uv = uv[:, chosen, :BODY].reshape(C, -1, 2)
    return refine_rig(given, rig, p, uv, weight[:, chosen, :BODY].reshape(C, -1), settings)


def _mean_seen(values: Float, weight: Float) -> Float:
    """``[F, J]`` mean over the cameras that see a joint."""
    return np.asarray(values.sum(0) / np.maximum((weight > 0).sum(0), 1))


def stage_medians(stages: dict[str, Float]) -> dict[str, tuple[float, list[float], float]]:
    """By stage: median error in pixels over all, by camera, and the share of detections used."""
    seen = max(1, *(int(np.isfinite(error).sum()) for error in stages.values()))
    return {
        name: (
            median(error),
            [median(one) for one in error],
            float(np.isfinite(error).sum() / seen),
        )
        for name, error in stages.items()
    }


def median(values: Float) -> float:
    """The median of what is finite; NaN of nothing."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")
