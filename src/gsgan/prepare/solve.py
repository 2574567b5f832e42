"""From 2D detections to 3D joints and refined cameras, with the error after every stage."""

from dataclasses import dataclass

import numpy as np

from gsgan.data.joints import ALL, BODY, FLIP_GROUPS, HAND_PAIRS, HANDS, WRISTS, known
from gsgan.prepare.camera_array import FOCAL, MIN_VIEWS, CameraArray, refine_cameras
from gsgan.prepare.cleanse import cleanse, smooth
from gsgan.prepare.triangulate import (
    FLIP_GAIN,
    Triangulated,
    apply_flips,
    cheapest_flips,
    find_flips,
    plain,
    points_and_cost,
    robust,
)
from gsgan.skeleton.hands import HAND
from gsgan.utils.arrays import Bool, Float, Ints, evenly_spaced, nanmedian
from gsgan.utils.checks import above, at_least, whole

# Errors and distances are in thousandths of the focal length.
WRIST = 40.0  # distance from the pose's wrist at which it counts half
MAX_ERROR = 20.0  # median error beyond which a detected hand is left out
OWN_PAIRS = tuple((j, j + HAND) for j in range(len(HAND_PAIRS)))


def match_hands(cameras: CameraArray, uv: Float, weight: Float, wrists: Float) -> Bool:
    """``[C, F]`` in which camera and frame left and right hand are swapped.

    Each view starts with the assignment whose hands are nearer to the wrists of the pose; then one
    camera at a time is changed as long as distances to the wrists and errors of triangulated hands
    become smaller together. Of an assignment and its opposite in all cameras, the one with the
    smaller distances to the wrists is taken.

    Args:
        cameras: ``C`` cameras.
        uv, weight: ``[C, F, 42, 2]`` undistorted pixels, the left hand's first, NaN = not seen, and
            their confidence.
        wrists: ``[C, F, 2, 2]`` where the pose's wrists are in each view; NaN = unknown.
    """
    roots = uv.reshape(*uv.shape[:2], 2, HAND, -1)[:, :, :, 0]
    certain = weight.reshape(*weight.shape[:2], 2, HAND, -1)[:, :, :, 0]
    # [C, F, hand, wrist]
    off = np.linalg.norm(roots[:, :, :, None] - wrists[:, :, None], axis=-1)
    # A hand is left out where one wrist is unknown: its distances cannot be compared.
    known = np.isfinite(off).all(-1, keepdims=True)
    loss = np.where(known, HAND * certain * np.log1p((off / WRIST) ** 2), 0.0)
    kept = loss[..., 0, 0] + loss[..., 1, 1]
    swapped = loss[..., 0, 1] + loss[..., 1, 0]

    def cost_of(flips: Bool, at: Ints) -> Float:
        sided = apply_flips(uv[:, at], flips[..., None], [OWN_PAIRS])
        seen = apply_flips(weight[:, at], flips[..., None], [OWN_PAIRS])
        far = np.where(flips, swapped[:, at], kept[:, at]).sum(0)
        return np.asarray(points_and_cost(cameras, sided, seen)[1] + far)

    flips = cheapest_flips(cost_of, swapped < kept, FLIP_GAIN * weight.sum(-1))
    everywhere = np.arange(flips.shape[1])
    return flips ^ (cost_of(~flips, everywhere) < cost_of(flips, everywhere))


def misfits(error: Float) -> Bool:
    """``[C, F, 2]`` hands whose median of ``error [C, F, 42]`` is above `MAX_ERROR`.

    They are another person's, something else, or the same hand detected twice.
    """
    return nanmedian(error.reshape(*error.shape[:2], 2, HAND), -1) > MAX_ERROR


REFINED = 200  # most frames that refine the cameras, evenly spaced
LAG = 6  # frames by which clocks are compared, either way


@dataclass(frozen=True)
class SolveSettings:
    """What the solution depends on, see conf/prepare.yaml."""

    min_confidence: float = 0.1
    refinements: int = 2
    rotation_prior: float = 2.0
    position_prior: float = 0.05
    smoothing: float = 0.02

    def __post_init__(self) -> None:
        whole("solve.refinements", self.refinements, 0)
        above("solve.rotation_prior", self.rotation_prior)
        above("solve.position_prior", self.position_prior)
        at_least("solve.smoothing", self.smoothing, 0)


@dataclass(frozen=True)
class Solution:
    """Joints, cameras, and how well they agree; NaN = missing or not seen."""

    cameras: CameraArray  # refined
    p: Float  # [F, J, 3] metres
    # [F, J] mean confidence of the cameras that see the joint, 0 where missing
    conf: Float
    error: Float  # [C, F, J] final reprojection error, full-size undistorted pixels
    # [C, F, G] where left and right were swapped: `FLIP_GROUPS`, then the hands
    flips: Bool
    left_out: Bool  # [C, F, 2] detected hands that are not the person's, or are repeats
    delay: Float  # [C] of each camera's clock, see `clock_errors`
    gain: Float  # [C] the same
    stages: dict[str, Float]  # name of each stage and its body errors [C, F, 33]
    removed: dict[str, int]  # number of joints removed, by reason

    @property
    def swapped(self) -> Bool:
        """``[C, F]`` where left and right of the body were swapped."""
        return np.asarray(self.flips[..., : len(FLIP_GROUPS)].any(-1))

    @property
    def swapped_hands(self) -> Bool:
        """``[C, F]`` where the hands were swapped."""
        return np.asarray(self.flips[..., len(FLIP_GROUPS) :].any(-1))


@dataclass(frozen=True)
class Corrected:
    """Detections with left and right corrected, and the points triangulated from them."""

    uv: Float  # [C, F, J, 2]
    weight: Float  # [C, F, J]
    flips: Bool  # [C, F, G] as in `Solution`
    left_out: Bool  # [C, F, 2]
    points: Triangulated  # of F * J


def solve(
    cameras: CameraArray, time: Float, uv: Float, conf: Float, settings: SolveSettings
) -> Solution:
    """All stages: plain, robust, flips, refined, smoothed.

    Args:
        cameras: as calibrated.
        time: ``[F]`` seconds.
        uv: ``[C, F, J, 2]`` undistorted pixels, NaN = not seen; J is 33, or 105 with hands
            and face.
        conf: ``[C, F, J]`` 0 = not seen.
        settings: of every stage.
    """
    given = cameras
    to_pixels = (given.focal / FOCAL)[:, None, None]
    cameras, scaled = cameras.normalised(uv)
    weight = np.where(conf > settings.min_confidence, conf, 0.0)

    # Triangulate as detected, then with left and right corrected.
    detected = _flat(scaled), _flat(weight)
    stages = {
        "plain": cameras.errors(plain(cameras, *detected), detected[0]),
        "robust": robust(cameras, *detected).error,
    }
    found = correct(cameras, scaled, weight)
    stages["flips"] = found.points.error
    cameras, found = _refined(cameras, scaled, weight, found, settings)
    stages["refined"] = found.points.error

    # Remove impossible joints and smooth the rest.
    p, removed = cleanse(found.points.p.reshape(*conf.shape[1:], 3))
    agreed = _mean_seen(found.points.weight.reshape(conf.shape), found.weight)
    p = smooth(p, agreed, time, settings.smoothing)
    error = cameras.errors(p.reshape(-1, 3), _flat(found.uv)).reshape(conf.shape)
    stages["smoothed"] = error = np.where(found.weight > 0, error, np.nan)

    delay, gain = clock_errors(
        cameras, found.uv[:, :, :BODY], found.weight[:, :, :BODY]
    )
    return Solution(
        cameras=CameraArray(given.K, cameras.R, cameras.t),
        p=p,
        conf=np.where(known(p), _mean_seen(found.weight, found.weight), 0.0),
        error=error * to_pixels,
        flips=found.flips,
        left_out=found.left_out,
        delay=delay,
        gain=gain,
        stages={
            name: one.reshape(conf.shape)[:, :, :BODY] * to_pixels
            for name, one in stages.items()
        },
        removed=removed,
    )


def _refined(
    start: CameraArray,
    uv: Float,
    weight: Float,
    found: Corrected,
    settings: SolveSettings,
) -> tuple[CameraArray, Corrected]:
    """Refines the cameras and triangulates again, in turn."""
    cameras, (F, J) = start, weight.shape[1:]
    at = np.array(evenly_spaced(F, REFINED, ends=True))
    priors = settings.rotation_prior, settings.position_prior
    for _ in range(settings.refinements):
        p = found.points.p.reshape(F, J, 3)[at].reshape(-1, 3)
        some = _flat(found.uv[:, at]), _flat(found.weight[:, at])
        cameras = refine_cameras(start, cameras, p, *some, *priors)
        found = correct(cameras, uv, weight)
    return cameras, found


def correct(cameras: CameraArray, uv: Float, conf: Float) -> Corrected:
    """Corrects swapped sides of body and hands, leaves strange hands out, and triangulates.

    ``uv [C, F, J, 2]`` are in thousandths of the focal length, ``conf [C, F, J]`` is 0 where a
    joint is not seen.
    """
    flips = find_flips(cameras, uv, conf, FLIP_GROUPS)
    sided = apply_flips(uv, flips, FLIP_GROUPS)
    weight = apply_flips(conf, flips, FLIP_GROUPS)
    left_out = np.zeros((*conf.shape[:2], 2), bool)
    if uv.shape[2] != ALL:
        points = robust(cameras, _flat(sided), _flat(weight))
        return Corrected(sided, weight, flips, left_out, points)

    # Where a camera does not see a wrist, the other cameras show where it is.
    own = np.where(weight[..., WRISTS, None] > 0, sided[:, :, WRISTS], np.nan)
    arms = robust(cameras, _flat(own), _flat(weight[:, :, WRISTS]))
    wrists = np.where(
        np.isfinite(own), own, cameras.project(arms.p)[0].reshape(own.shape)
    )

    hands = sided[:, :, HANDS], weight[:, :, HANDS], wrists
    swapped = match_hands(cameras, *hands)
    sided = apply_flips(sided, swapped[..., None], [HAND_PAIRS])
    weight = apply_flips(weight, swapped[..., None], [HAND_PAIRS])
    points = robust(cameras, _flat(sided), _flat(weight))
    left_out = misfits(points.error.reshape(conf.shape)[:, :, HANDS])
    weight[:, :, HANDS] *= ~left_out.repeat(HAND, axis=-1)
    points = robust(cameras, _flat(sided), _flat(weight))
    return Corrected(
        sided, weight, np.dstack([flips, swapped[..., None]]), left_out, points
    )


def _flat(values: Float) -> Float:
    return values.reshape(values.shape[0], -1, *values.shape[3:])


def _mean_seen(values: Float, weight: Float) -> Float:
    """``[F, J]`` mean over the cameras that see a joint."""
    return np.asarray(values.sum(0) / np.maximum((weight > 0).sum(0), 1))


def clock_errors(cameras: CameraArray, uv: Float, weight: Float) -> tuple[Float, Float]:
    """Each camera's delay against the others, and the gain of correcting it.

    Convention: frames; with a positive delay the camera shows a later moment than the others at the
    same number, so its numbers should grow by that much. Triangulated are triangulated without the
    camera, so three cameras are needed; with two the delay is NaN. Between frames a parabola
    through the three best lags decides.

    Args:
        cameras: ``C`` cameras.
        uv, weight: ``[C, F, J, 2]`` undistorted pixels and their confidence.

    Returns:
        ``delay [C]`` and ``gain [C]``, the share by which the median error falls.
    """
    C, F, _ = weight.shape
    delay = np.full(C, np.nan)
    gain = np.full(C, np.nan)
    lag = min(LAG, F - 1)
    cameras, uv = cameras.normalised(uv)
    if C <= MIN_VIEWS or lag < 1:
        return delay, gain
    for c in range(C):
        others = np.arange(C) != c
        p = robust(cameras[others], _flat(uv[others]), _flat(weight[others])).p
        expected = cameras.project(p)[0][c].reshape(uv.shape[1:])
        seen = np.where((weight[c] > 0)[..., None], uv[c], np.nan)
        errors = []
        # the camera's frame f against the others' frame f - s
        for s in range(-lag, lag + 1):
            ours = seen[max(s, 0) : F + min(s, 0)]
            theirs = expected[max(-s, 0) : F - max(s, 0)]
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
