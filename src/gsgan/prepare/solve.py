"""From 2D detections to 3D joints and refined cameras, with the error after every stage."""

from dataclasses import dataclass

import numpy as np

from gsgan.prepare.camera_array import (
    UNIT_FOCAL,
    CameraArray,
    refine_cameras,
)
from gsgan.prepare.cleanse import cleanse, smooth
from gsgan.prepare.clocks import clock_errors
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
from gsgan.skeleton.joints import (
    ALL,
    BODY,
    FLIP_GROUPS,
    HAND_PAIRS,
    HANDS,
    WRIST_JOINTS,
    known,
)
from gsgan.utils.arrays import Bool, Float, Ints, evenly_spaced, nanmedian
from gsgan.utils.checks import above, at_least, whole

# Errors and distances are in thousandths of the focal length.
WRIST_SCALE = 40.0  # distance from the pose's wrist at which a hand counts half
MAX_HAND_ERROR = 20.0  # maximum median error of a detected hand
OWN_PAIRS = tuple((j, j + HAND) for j in range(len(HAND_PAIRS)))
REFINED = 200  # maximum number of frames that refine the cameras, evenly spaced


def match_hands(
    cameras: CameraArray, uv: Float, weight: Float, wrists: Float
) -> Bool:
    """The cameras and frames ``[C, F]`` in which left and right hand are swapped.

    Each view starts with the assignment whose hands are nearer to the wrists of the pose; then one
    camera at a time is changed as long as distances to the wrists and errors of triangulated hands
    become smaller together. Of an assignment and its opposite in all cameras, the one with the
    smaller distances to the wrists is taken.

    Args:
        cameras: ``C`` cameras.
        uv: ``[C, F, 42, 2]`` undistorted pixels, the left hand's first, NaN = not seen.
        weight: ``[C, F, 42]`` their confidence.
        wrists: ``[C, F, 2, 2]`` the pose's wrists in each view; NaN = unknown.
    """
    # Distances [C, F, hand, wrist] of the first landmark of each hand from the pose's wrists.
    C, F, _ = weight.shape
    roots = uv.reshape(C, F, 2, HAND, 2)[:, :, :, 0]
    root_weight = weight.reshape(C, F, 2, HAND, 1)[:, :, :, 0]
    distance = np.linalg.norm(
        roots[:, :, :, None] - wrists[:, :, None], axis=-1
    )

    # A hand is left out if one wrist is unknown: its distances cannot be compared.
    known = np.isfinite(distance).all(-1, keepdims=True)
    loss = HAND * root_weight * np.log1p((distance / WRIST_SCALE) ** 2)
    loss = np.where(known, loss, 0.0)

    # What keeping or swapping the hands costs, by their distances to the
    # wrists.
    kept = loss[..., 0, 0] + loss[..., 1, 1]
    swapped = loss[..., 0, 1] + loss[..., 1, 0]

    # The errors of the triangulated hands are added.
    def cost_of(flips: Bool, at: Ints) -> Float:
        sided = apply_flips(uv[:, at], flips[..., None], [OWN_PAIRS])
        seen = apply_flips(weight[:, at], flips[..., None], [OWN_PAIRS])
        from_wrists = np.where(flips, swapped[:, at], kept[:, at]).sum(0)
        _, cost = points_and_cost(cameras, sided, seen)
        return cost + from_wrists

    # Hands nearer to the other wrist start swapped.
    flips = cheapest_flips(cost_of, swapped < kept, FLIP_GAIN * weight.sum(-1))
    everywhere = np.arange(F)
    return flips ^ (cost_of(~flips, everywhere) < cost_of(flips, everywhere))


def misfits(error: Float) -> Bool:
    """The hands ``[C, F, 2]`` whose median of ``error [C, F, 42]`` is above `MAX_HAND_ERROR`.

    They are another person's, something else, or the same hand detected twice.
    """
    by_hand = error.reshape(*error.shape[:2], 2, HAND)
    return nanmedian(by_hand, -1) > MAX_HAND_ERROR


@dataclass(frozen=True)
class SolveSettings:
    """Settings of the solution, see conf/prepare.yaml."""

    min_confidence: float = 0.1  # of a detection
    refinements: int = 2  # number of rounds
    rotation_prior: float = 2.0  # standard deviation, degrees
    position_prior: float = 0.05  # standard deviation, metres
    smoothing: float = 0.02  # seconds

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
    gain: Float  # [C] of correcting that clock
    # name of each stage and its body errors [C, F, 33]
    stages: dict[str, Float]
    removed: dict[str, int]  # number of joints removed, by reason

    @property
    def swapped(self) -> Bool:
        """The frames ``[C, F]`` with left and right of the body swapped."""
        return np.asarray(self.flips[..., : len(FLIP_GROUPS)].any(-1))

    @property
    def swapped_hands(self) -> Bool:
        """The frames ``[C, F]`` with the hands swapped."""
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
    cameras: CameraArray,
    time: Float,
    uv: Float,
    conf: Float,
    settings: SolveSettings,
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
    # Errors are in pixels of cameras of one focal length.
    given = cameras
    to_pixels = (given.focal / UNIT_FOCAL)[:, None, None]
    cameras, scaled = cameras.normalised(uv)
    weight = np.where(conf > settings.min_confidence, conf, 0.0)

    # Triangulate as detected, then with left and right corrected.
    flat_uv = _flat(scaled)
    flat_weight = _flat(weight)
    linear = plain(cameras, flat_uv, flat_weight)
    stages = {
        "plain": cameras.errors(linear, flat_uv),
        "robust": robust(cameras, flat_uv, flat_weight).error,
    }

    # Swapped sides first: they would bend the cameras.
    found = correct(cameras, scaled, weight)
    stages["flips"] = found.points.error
    cameras, found = _refined(cameras, scaled, weight, found, settings)
    stages["refined"] = found.points.error

    # Remove impossible joints and smooth the rest.
    p, removed = cleanse(found.points.p.reshape(*conf.shape[1:], 3))
    final_weight = found.points.weight.reshape(conf.shape)
    agreed = _mean_seen(final_weight, found.weight)
    p = smooth(p, agreed, time, settings.smoothing)

    # The final errors, of detections that were used.
    error = cameras.errors(p.reshape(-1, 3), _flat(found.uv))
    error = np.where(found.weight > 0, error.reshape(conf.shape), np.nan)
    stages["smoothed"] = error

    # Errors by stage are those of the body, in pixels of each camera.
    stages_in_pixels = {}
    for name, values in stages.items():
        of_body = values.reshape(conf.shape)[:, :, :BODY]
        stages_in_pixels[name] = of_body * to_pixels

    # Clocks by the given cameras: late ones would bend the refined cameras.
    delay, gain = clock_errors(
        given,
        uv[:, :, :BODY],
        np.where(conf > settings.min_confidence, conf, 0.0)[:, :, :BODY],
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
        stages=stages_in_pixels,
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
    # Some frames are enough for the cameras; each round begins with better points.
    cameras = start
    F = weight.shape[1]
    at = np.array(evenly_spaced(F, REFINED, ends=True))

    # The prior pulls towards the given cameras, not towards those of the last
    # round.
    for _ in range(settings.refinements):
        p = found.points.p.reshape(F, -1, 3)[at]
        cameras = refine_cameras(
            given=start,
            start=cameras,
            p=p.reshape(-1, 3),
            uv=_flat(found.uv[:, at]),
            weight=_flat(found.weight[:, at]),
            rotation_prior=settings.rotation_prior,
            position_prior=settings.position_prior,
        )
        found = correct(cameras, uv, weight)
    return cameras, found


def correct(cameras: CameraArray, uv: Float, conf: Float) -> Corrected:
    """Corrects swapped sides of body and hands, leaves strange hands out, and triangulates.

    Args:
        cameras: ``C`` cameras.
        uv: ``[C, F, J, 2]`` thousandths of the focal length.
        conf: ``[C, F, J]`` 0 = not seen.
    """
    # Sides of the body.
    flips = find_flips(cameras, uv, conf, FLIP_GROUPS)
    sided = apply_flips(uv, flips, FLIP_GROUPS)
    weight = apply_flips(conf, flips, FLIP_GROUPS)
    left_out = np.zeros((*conf.shape[:2], 2), bool)
    if uv.shape[2] != ALL:
        points = robust(cameras, _flat(sided), _flat(weight))
        return Corrected(sided, weight, flips, left_out, points)

    # If a camera does not see a wrist, the other cameras show where it is.
    sees_wrist = weight[..., WRIST_JOINTS, None] > 0
    own = np.where(sees_wrist, sided[:, :, WRIST_JOINTS], np.nan)
    arms = robust(cameras, _flat(own), _flat(weight[:, :, WRIST_JOINTS]))
    projected, _ = cameras.project(arms.p)
    wrists = np.where(np.isfinite(own), own, projected.reshape(own.shape))

    # Sides of the hands.
    swapped = match_hands(
        cameras, sided[:, :, HANDS], weight[:, :, HANDS], wrists
    )
    swapped = swapped[..., None]
    sided = apply_flips(sided, swapped, [HAND_PAIRS])
    weight = apply_flips(weight, swapped, [HAND_PAIRS])

    # Hands that do not fit those of other cameras are left out.
    points = robust(cameras, _flat(sided), _flat(weight))
    left_out = misfits(points.error.reshape(conf.shape)[:, :, HANDS])
    weight[:, :, HANDS] *= ~left_out.repeat(HAND, axis=-1)
    points = robust(cameras, _flat(sided), _flat(weight))
    return Corrected(
        sided, weight, np.dstack([flips, swapped]), left_out, points
    )


def _flat(values: Float) -> Float:
    """Values ``[C, F, J, ...]`` as ``[C, F J, ...]``."""
    return values.reshape(values.shape[0], -1, *values.shape[3:])


def _mean_seen(values: Float, weight: Float) -> Float:
    """The mean ``[F, J]`` over the cameras that see a joint."""
    views = (weight > 0).sum(0)
    return values.sum(0) / np.maximum(views, 1)


def median(values: Float) -> float:
    """The median of the finite values, NaN when there are none."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")
