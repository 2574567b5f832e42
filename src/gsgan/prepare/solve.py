"""From 2D detections to 3D joints and refined cameras, with the error after every stage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.data.joints import ALL, BODY, FLIP_GROUPS, HAND_PAIRS, HANDS, WRISTS, known
from gsgan.prepare.cleanse import Cleansing, Smoothing, cleanse, smooth
from gsgan.prepare.hands import HandMatching, match_hands, misfits
from gsgan.prepare.landmarks import without_frozen
from gsgan.prepare.rig import FOCAL, MIN_VIEWS, Bool, Float, Ints, Refinement, Rig, refine_rig
from gsgan.prepare.triangulate import FlipSearch, Points, Triangulation, apply_flips, find_flips
from gsgan.skeleton.hands import HAND
from gsgan.utils.arrays import evenly_spaced

ARRAYS = ("p", "conf", "views", "error", "uv", "seen", "flips", "left_out", "delay", "gain")


@dataclass(frozen=True)
class Settings:
    """The settings of every stage."""

    triangulation: Triangulation = field(default_factory=Triangulation)
    flips: FlipSearch = field(default_factory=FlipSearch)
    hands: HandMatching = field(default_factory=HandMatching)
    refinement: Refinement = field(default_factory=Refinement)
    cleansing: Cleansing = field(default_factory=Cleansing)
    smoothing: Smoothing = field(default_factory=Smoothing)


@dataclass(frozen=True)
class Solution:
    """Joints, cameras, and how well they agree; NaN = missing or not seen."""

    rig: Rig  # refined
    p: Float  # [F, J, 3] metres
    conf: Float  # [F, J] mean confidence of the cameras that see the joint, 0 where missing
    views: Ints  # [F, J] cameras whose detection lies within the triangulation's scale
    error: Float  # [C, F, J] final reprojection error, full-size undistorted pixels
    uv: Float  # [C, F, J, 2] undistorted detections with the sides corrected
    seen: Float  # [C, F, J] their confidence
    flips: Bool  # [C, F, G] sides that were swapped: of `FLIP_GROUPS`, then of the hands
    left_out: Bool  # [C, F, 2] detected hands that are none of the person's two, or a repeat
    delay: Float  # [C] of each camera's clock, see `clock_errors`
    gain: Float  # [C] the same
    stages: dict[str, Float]  # name of each stage and its body errors [C, F, 33]
    removed: dict[str, int]  # number of joints removed, by reason

    @property
    def swapped(self) -> Bool:
        """``[C, F]`` where sides of the body were swapped."""
        return np.asarray(self.flips[..., : len(FLIP_GROUPS)].any(-1))

    @property
    def swapped_hands(self) -> Bool:
        """``[C, F]`` where the hands were swapped."""
        return np.asarray(self.flips[..., len(FLIP_GROUPS) :].any(-1))

    def off(self, limit: float) -> Bool:
        """``[C]`` cameras whose median error, of all landmarks, is above the limit, in thousandths
        of the focal length: those of a body alone are vague where it is near."""
        errors = np.array([median(error) for error in self.error])
        return np.asarray(errors > limit * self.rig.focal / FOCAL)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """All of it as plain arrays."""
        return {
            **{name: getattr(self, name) for name in ARRAYS},
            **{f"rig {name}": value for name, value in vars(self.rig).items()},
            **{f"stage {name}": value for name, value in self.stages.items()},
            **{f"removed {name}": np.array(count) for name, count in self.removed.items()},
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Solution:
        """The inverse of `to_arrays`."""

        def group(start: str) -> dict[str, NDArray[Any]]:
            return {
                key.removeprefix(start): a for key, a in arrays.items() if key.startswith(start)
            }

        return cls(
            rig=Rig(**group("rig ")),
            stages=group("stage "),
            removed={name: int(count) for name, count in group("removed ").items()},
            **{name: arrays[name] for name in ARRAYS},
        )


def solve(
    rig: Rig, time: Float, uv: Float, conf: Float, settings: Settings, lag: int = 0
) -> Solution:
    """All stages: plain, robust, flips, refined, smoothed.

    Args:
        rig: as calibrated.
        time: ``[F]`` seconds.
        uv: ``[C, F, J, 2]`` undistorted pixels, NaN = not seen; J is 33, or 105 with hands
            and face.
        conf: ``[C, F, J]`` 0 = not seen.
        settings: of every stage.
        lag: frames tried either way when clocks are compared; 0 skips it.
    """
    triangulation, given, pixels, full = settings.triangulation, rig, uv, conf
    hands = uv.shape[2] == ALL
    groups = (*FLIP_GROUPS, HAND_PAIRS) if hands else FLIP_GROUPS
    rig, uv = rig.normalised(uv)
    start, conf = rig, np.where(conf > triangulation.min_confidence, conf, 0.0)
    flips = np.zeros((*conf.shape[:2], len(groups)), bool)
    left_out = np.zeros((*conf.shape[:2], 2), bool)
    sided, weight = uv, conf

    def triangulate() -> Points:
        nonlocal flips, left_out, sided, weight
        sided, weight = uv, conf
        if settings.flips.enabled:
            body = find_flips(rig, uv, conf, FLIP_GROUPS, settings.flips, triangulation)
            flips[..., : len(FLIP_GROUPS)] = body
            sided, weight = (apply_flips(v, body, FLIP_GROUPS) for v in (uv, conf))
        if hands:
            own = np.where(weight[..., WRISTS, None] > 0, sided[:, :, WRISTS], np.nan)
            arms = triangulation.points(rig, _flat(own), _flat(weight[:, :, WRISTS]))
            far = rig.project(arms.p)[0].reshape(own.shape)
            wrists = np.where(np.isfinite(own), own, far)  # unseen: where other cameras see it
            found = sided[:, :, HANDS], weight[:, :, HANDS], wrists
            flips[..., -1] = match_hands(rig, *found, settings.hands, triangulation)
            sided, weight = (apply_flips(v, flips, groups) for v in (uv, conf))
        points = triangulation.points(rig, _flat(sided), _flat(weight))
        if hands:
            error = points.error.reshape(conf.shape)[:, :, HANDS]
            left_out = misfits(error, settings.hands.max_error)
            weight = weight.copy()
            weight[:, :, HANDS] *= ~left_out.repeat(HAND, axis=-1)
            points = triangulation.points(rig, _flat(sided), _flat(weight))
        return points

    plain = triangulation.plain(rig, _flat(uv), _flat(conf))
    robust = triangulation.points(rig, _flat(uv), _flat(conf))
    stages = {"plain": rig.errors(plain, _flat(uv)), "robust": robust.error}
    points = triangulate()
    stages["flips"] = points.error
    F, J = conf.shape[1:]
    at = np.array(evenly_spaced(F, settings.refinement.frames, ends=True))
    for _ in range(settings.refinement.rounds):
        p = points.p.reshape(F, J, 3)[at].reshape(-1, 3)
        detections = _flat(sided[:, at]), _flat(weight[:, at])
        rig = refine_rig(start, rig, p, *detections, settings.refinement)
        points = triangulate()
    stages["refined"] = points.error
    p, removed = cleanse(points.p.reshape(*conf.shape[1:], 3), settings.cleansing)
    agreed = _mean_seen(points.weight.reshape(conf.shape), weight)
    p = smooth(p, agreed, time, settings.smoothing.seconds)
    error = rig.errors(p.reshape(-1, 3), _flat(sided)).reshape(conf.shape)
    stages["smoothed"] = error = np.where(weight > 0, error, np.nan)
    trust, pixels = (apply_flips(v, flips, groups) for v in (full, pixels))
    if hands:
        gone = left_out.repeat(HAND, axis=-1)
        trust[:, :, HANDS][gone], pixels[:, :, HANDS][gone] = 0.0, np.nan
    delay, gain = clock_errors(rig, sided[:, :, :BODY], trust[:, :, :BODY], triangulation, lag)
    to_pixels = (given.focal / FOCAL)[:, None, None]
    return Solution(
        rig=Rig(given.K, rig.R, rig.t),
        p=p,
        conf=np.where(known(p), _mean_seen(weight, weight), 0.0),
        views=(np.nan_to_num(error, nan=np.inf) <= triangulation.scale).sum(0),
        error=error * to_pixels,
        uv=pixels,
        seen=trust,
        flips=flips,
        left_out=left_out,
        delay=delay,
        gain=gain,
        stages={
            name: one.reshape(conf.shape)[:, :, :BODY] * to_pixels for name, one in stages.items()
        },
        removed=removed,
    )


def adopt(
    rig: Rig, time: Float, p: Float, conf: Float, settings: Settings, frozen: int
) -> Solution:
    """Another tool's joints, cleansed and smoothed; the cameras stay as calibrated.

    ``time [F]`` is in seconds, ``p [F, 33, 3]`` in metres with ``conf [F, 33]``; for ``frozen`` see
    `without_frozen`.
    """
    p, stuck = without_frozen(p, frozen)
    p, removed = cleanse(p, settings.cleansing)
    p = smooth(p, conf, time, settings.smoothing.seconds)
    C, (F, J) = len(rig), conf.shape
    unseen, unknown = np.full((C, F, J), np.nan), np.full(C, np.nan)
    return Solution(
        rig=rig,
        p=p,
        conf=np.where(known(p), conf, 0.0),
        views=np.zeros((F, J), np.int64),
        error=unseen,
        uv=np.full((C, F, J, 2), np.nan),
        seen=np.zeros((C, F, J)),
        flips=np.zeros((C, F, len(FLIP_GROUPS)), bool),
        left_out=np.zeros((C, F, 2), bool),
        delay=unknown,
        gain=unknown,
        stages={"smoothed": unseen},
        removed=removed | {"frozen": stuck},
    )


def _flat(values: Float) -> Float:
    return values.reshape(values.shape[0], -1, *values.shape[3:])


def _mean_seen(values: Float, weight: Float) -> Float:
    """``[F, J]`` mean over the cameras that see a joint."""
    return np.asarray(values.sum(0) / np.maximum((weight > 0).sum(0), 1))


def clock_errors(
    rig: Rig, uv: Float, weight: Float, triangulation: Triangulation, lag: int
) -> tuple[Float, Float]:
    """Each camera's delay against the others, and the gain of correcting it.

    Convention: frames; with a positive delay the camera shows a later moment than the others at the
    same number, so its numbers should grow by that much. Points are triangulated without the
    camera, so three cameras are needed; with two the delay is NaN. Between frames a parabola
    through the three best lags decides.

    Args:
        rig: ``C`` cameras.
        uv, weight: ``[C, F, J, 2]`` undistorted pixels and their confidence.
        triangulation, lag: its settings, and the frames tried either way.

    Returns:
        ``delay [C]`` and ``gain [C]``, the share by which the median error falls.
    """
    C, F, _ = weight.shape
    delay, gain, lag = np.full(C, np.nan), np.full(C, np.nan), min(lag, F - 1)
    rig, uv = rig.normalised(uv)
    if C <= MIN_VIEWS or lag < 1:
        return delay, gain
    for c in range(C):
        others = np.arange(C) != c
        p = triangulation.points(rig[others], _flat(uv[others]), _flat(weight[others])).p
        expected = rig.project(p)[0][c].reshape(uv.shape[1:])
        seen = np.where((weight[c] > 0)[..., None], uv[c], np.nan)
        errors = []
        for s in range(-lag, lag + 1):  # the camera's frame f against the others' frame f - s
            ours, theirs = seen[max(s, 0) : F + min(s, 0)], expected[max(-s, 0) : F - max(s, 0)]
            errors.append(median(np.linalg.norm(ours - theirs, axis=-1)))
        if np.isfinite(errors[lag]):
            best = int(np.nanargmin(errors))
            delay[c] = lag - best - _vertex(errors[max(best - 1, 0) : best + 2])
            gain[c] = 1 - errors[best] / max(errors[lag], 1e-12)
    return delay, gain


def _vertex(values: list[float]) -> float:
    """Where a parabola through values at -1, 0, 1 is lowest; 0 with fewer values or none lowest."""
    if len(values) < 3 or not values[0] - 2 * values[1] + values[2] > 0:
        return 0.0
    return 0.5 * (values[0] - values[2]) / (values[0] - 2 * values[1] + values[2])


def median(values: Float) -> float:
    """The median of the finite values, NaN when there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")
