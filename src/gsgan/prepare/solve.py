"""From 2D detections to 3D joints and refined cameras, with the error after every stage."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch

from gsgan.prepare.camera_array import (
    MIN_VIEWS,
    UNIT_FOCAL,
    CameraArray,
    refine_cameras,
)
from gsgan.prepare.cleanse import cleanse, smooth
from gsgan.prepare.clocks import ClockErrors, clock_errors
from gsgan.prepare.frontier import Outline, frontier_points
from gsgan.prepare.many_views import Views, solve_views
from gsgan.prepare.sides import (
    FLIP_GAIN,
    apply_flips,
    cheapest_flips,
    find_flips,
)
from gsgan.prepare.triangulate import (
    Triangulated,
    plain,
    points_and_cost,
    robust,
)
from gsgan.skeleton.hands import HAND
from gsgan.skeleton.joints import (
    ALL,
    BODY,
    FLIP_GROUPS,
    FROM_PARTS,
    HAND_PAIRS,
    HANDS,
    WRIST_JOINTS,
    is_known,
)
from gsgan.utils.arrays import Bool, Float, Ints, nanmedian
from gsgan.utils.checks import at_least, integer, positive

# Errors and distances are in thousandths of the focal length.
WRIST_SCALE = 40.0  # distance from the pose's wrist at which a hand counts half
MAX_HAND_ERROR = 20.0  # maximum median error of a detected hand
OWN_PAIRS = tuple((j, j + HAND) for j in range(len(HAND_PAIRS)))
# Weights of a landmark against a frontier point that are tried: landmarks are many, and off in the
# same direction, but a person who hardly moves has few different frontier points.
LANDMARK_WEIGHTS = (0.01, 1.0)
MIN_FRONTIER = 60  # frontier points: fewer do not judge cameras
# Refined cameras are taken if silhouettes are nearer to epipolar lines than this share of their
# distance with the given ones, in frames that took no part.
BETTER = 0.9
# Pixels: silhouettes, which are of whole pixels, do not judge cameras by which they agree so well.
PIXELATION = 0.5
# The same for two cameras, whose single pair does not average the error of masks: outlines are off
# by so much at 90 % (docs/results/prepare.md).
PAIR_ERROR = 1.5
# Landmarks are biased, so they may fit better cameras worse; but in no camera by this factor: then
# silhouettes are cut off, or of something else. An error of a thousandth of the focal length is
# usual.
CONTRADICTED = 1.5
USUAL_ERROR = 1.0
INFERRED = 0.1  # confidence of a joint that no two cameras see, but a body has


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
    has_distance = np.isfinite(distance).all(-1, keepdims=True)
    loss = HAND * root_weight * np.log1p((distance / WRIST_SCALE) ** 2)
    loss = np.where(has_distance, loss, 0.0)

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

    min_confidence: float  # of a detection
    refinements: int  # number of rounds
    rotation_prior: float  # standard deviation, degrees
    position_prior: float  # standard deviation, metres
    smoothing: float  # seconds
    body: bool  # joints are those of one body in smooth motion
    # standard deviation of a landmark, thousandths of the focal length
    noise: float

    def __post_init__(self) -> None:
        integer("solve.refinements", self.refinements, 0)
        positive("solve.rotation_prior", self.rotation_prior)
        positive("solve.position_prior", self.position_prior)
        at_least("solve.smoothing", self.smoothing, 0)
        positive("solve.noise", self.noise)


@dataclass(frozen=True)
class Solution:
    """Joints, cameras, and how well they agree; NaN = missing or not seen."""

    cameras: CameraArray  # refined
    p: Float  # [F, J, 3] metres
    # [F, J] mean confidence of the cameras that see the joint, `INFERRED` where the body alone says
    # where it is, 0 where missing
    conf: Float
    seen: Bool  # [F, J] whether the joint came from detections
    error: Float  # [C, F, J] final reprojection error, full-size undistorted pixels
    # [C, F, G] where left and right were swapped: `FLIP_GROUPS`, then the hands
    flips: Bool
    left_out: Bool  # [C, F, 2] detected hands that are not the person's, or are repeats
    clocks: ClockErrors
    # name of each stage and its body errors [C, F, 33]
    stages: dict[str, Float]
    # median distance of silhouettes from epipolar lines, pixels: given cameras, refined ones
    frontier: tuple[float, float]
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
    outlines: Sequence[Sequence[Outline | None]],
    settings: SolveSettings,
) -> Solution:
    """All stages: plain, robust, flips, refined, body.

    Args:
        cameras: as calibrated.
        time: ``[F]`` seconds.
        uv: ``[C, F, J, 2]`` undistorted pixels, NaN = not seen; J is 33, or 105 with hands
            and face.
        conf: ``[C, F, J]`` 0 = not seen.
        outlines: of the silhouettes of each camera in each frame; they judge the cameras.
        settings: of every stage.
    """
    # Errors are in pixels of cameras of one focal length.
    given = cameras
    to_pixels = (given.focal / UNIT_FOCAL)[:, None, None]
    cameras, scaled = cameras.normalise(uv)
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
    corrected = correct(cameras, scaled, weight, time)
    stages["flips"] = corrected.points.error
    refined = refine(given, corrected, outlines, settings)
    if refined.cameras is not given:
        cameras, _ = refined.cameras.normalise(uv)
        corrected = correct(cameras, scaled, weight, time)
    stages["refined"] = corrected.points.error

    # Impossible joints are removed; joints of hands and face, or all, are smoothed.
    p, removed = cleanse(corrected.points.p.reshape(*conf.shape[1:], 3))
    final_weight = corrected.points.weight.reshape(conf.shape)
    agreed = _mean_seen(final_weight, corrected.weight)
    smoothed = smooth(p, agreed, time, settings.smoothing)

    # A body in smooth motion, from the views of all cameras.
    seen = is_known(p)
    if settings.body:
        of_body = body_joints(
            cameras, corrected.uv, corrected.weight, p, time, settings.noise
        )
        if is_known(of_body).any():
            smoothed[:, :BODY] = of_body
    p = smoothed
    conf_seen = _mean_seen(corrected.weight, corrected.weight)
    inferred = np.where(is_known(p), INFERRED, 0.0)

    # The final errors, of detections that were used.
    error = cameras.errors(p.reshape(-1, 3), _flat(corrected.uv))
    error = np.where(corrected.weight > 0, error.reshape(conf.shape), np.nan)
    stages["body" if settings.body else "smoothed"] = error

    # Errors by stage are those of the body, in pixels of each camera.
    stages_in_pixels = {}
    for name, values in stages.items():
        body_error = values.reshape(conf.shape)[:, :, :BODY]
        stages_in_pixels[name] = body_error * to_pixels

    # Clocks by the cameras that silhouettes have chosen: wrong ones look like late clocks.
    chosen = CameraArray(given.K, cameras.R, cameras.t)
    clocks = clock_errors(
        chosen,
        uv[:, :, :BODY],
        np.where(conf > settings.min_confidence, conf, 0.0)[:, :, :BODY],
    )
    return Solution(
        cameras=chosen,
        p=p,
        conf=np.where(seen & is_known(p), conf_seen, inferred),
        seen=seen,
        error=error * to_pixels,
        flips=corrected.flips,
        left_out=corrected.left_out,
        clocks=clocks,
        stages=stages_in_pixels,
        removed=removed,
        frontier=refined.frontier,
    )


class Refined(NamedTuple):
    """Cameras after the refinement, and what silhouettes say of them."""

    cameras: CameraArray
    # median distance of silhouettes from epipolar lines, pixels: given cameras, refined ones, NaN
    # where landmarks contradict these
    frontier: tuple[float, float]


def refine(
    given: CameraArray,
    corrected: Corrected,
    outlines: Sequence[Sequence[Outline | None]],
    settings: SolveSettings,
) -> Refined:
    """The given cameras, or refined ones where silhouettes show that these are better.

    A given calibration is evidence: detectors are wrong in the same direction in thousands of
    landmarks, which fit best if cameras move. Cameras are refined by frontier points and landmarks
    of every other frame, with each of `LANDMARK_WEIGHTS`; the frames between decide.

    Args:
        given: ``C`` cameras.
        corrected: landmarks of F frames, seen by these cameras.
        outlines: of each camera in each frame.
        settings: number of rounds, and the priors.
    """
    # Every other of the frames with outlines, and the frames between.
    some = [
        f for f, frame in enumerate(zip(*outlines, strict=True)) if any(frame)
    ]
    fitted = [[one[f] for f in some[::2]] for one in outlines]
    judging = [[one[f] for f in some[1::2]] for one in outlines]
    before = frontier_points(given, judging)
    error = float(np.nanmedian(before.error)) if before.uv.size else np.nan
    few = before.uv.shape[1] < MIN_FRONTIER
    usual = PIXELATION if len(given) > 2 else PAIR_ERROR
    if settings.refinements == 0 or few or error <= usual:
        return Refined(given, (error, error))

    # The best of the refined cameras, by the frames between. Landmarks must not contradict them.
    best = given
    lowest = np.nan
    limit = CONTRADICTED * np.maximum(
        _landmark_errors(given, corrected), USUAL_ERROR
    )
    for weight in LANDMARK_WEIGHTS:
        cameras = _refine_cameras(
            given, corrected, fitted, some[::2], weight, settings
        )
        if (_landmark_errors(cameras, corrected) > limit).any():
            continue
        after = float(np.nanmedian(frontier_points(cameras, judging).error))
        if np.isnan(lowest) or after < lowest:
            best = cameras
            lowest = after
    if not lowest <= BETTER * error:
        best = given
    return Refined(best, (error, lowest))


def _landmark_errors(cameras: CameraArray, corrected: Corrected) -> Float:
    """The median error ``[C]`` of the body's landmarks, thousandths of the focal length."""
    uv = _flat(corrected.uv[:, :, :BODY])
    unit, _ = cameras.normalise(uv)
    points = robust(unit, uv, _flat(corrected.weight[:, :, :BODY]))
    return nanmedian(points.error, -1)


def _refine_cameras(
    given: CameraArray,
    corrected: Corrected,
    outlines: Sequence[Sequence[Outline | None]],
    frames: Sequence[int],
    landmark_weight: float,
    settings: SolveSettings,
) -> CameraArray:
    """Cameras refined by the outlines and the body's landmarks of some frames."""
    # Pixels are those of one focal length.
    at = np.array(frames)
    to_unit = (UNIT_FOCAL / given.focal)[:, None, None]
    landmarks = _flat(corrected.uv[:, at, :BODY])
    weight = landmark_weight * _flat(corrected.weight[:, at, :BODY])
    unit, _ = given.normalise(landmarks)

    # The prior pulls towards the given cameras, not towards those of the last round.
    cameras = unit
    for _ in range(settings.refinements):
        now = replace(given, R=cameras.R, t=cameras.t)
        touching = to_unit * frontier_points(now, outlines).uv
        both = np.concatenate([landmarks, touching], axis=1)
        certain = is_known(touching).astype(np.float64)
        weights = np.concatenate([weight, certain], axis=1)
        cameras = refine_cameras(
            given=unit,
            start=cameras,
            p=robust(cameras, both, weights, max_error=np.inf).p,
            uv=both,
            weight=weights,
            rotation_prior=settings.rotation_prior,
            position_prior=settings.position_prior,
        )
    return replace(given, R=cameras.R, t=cameras.t)


def correct(
    cameras: CameraArray, uv: Float, conf: Float, time: Float
) -> Corrected:
    """Corrects swapped sides of body and hands, leaves strange hands out, and triangulates.

    Args:
        cameras: ``C`` cameras.
        uv: ``[C, F, J, 2]`` thousandths of the focal length.
        conf: ``[C, F, J]`` 0 = not seen.
        time: ``[F]`` seconds.
    """
    # Sides of the body.
    flips = find_flips(cameras, uv, conf, time)
    sided = apply_flips(uv, flips, FLIP_GROUPS)
    weight = apply_flips(conf, flips, FLIP_GROUPS)
    left_out = np.zeros((*conf.shape[:2], 2), bool)
    if uv.shape[2] != ALL:
        points = robust(cameras, _flat(sided), _flat(weight))
        return Corrected(sided, weight, flips, left_out, points)

    # If a camera does not see a wrist, the other cameras show where it is.
    sees_wrist = weight[..., WRIST_JOINTS, None] > 0
    wrists_seen = np.where(sees_wrist, sided[:, :, WRIST_JOINTS], np.nan)
    arms = robust(
        cameras, _flat(wrists_seen), _flat(weight[:, :, WRIST_JOINTS])
    )
    projected, _ = cameras.project(arms.p)
    wrists = np.where(
        np.isfinite(wrists_seen),
        wrists_seen,
        projected.reshape(wrists_seen.shape),
    )

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
    sided, weight = with_parts(sided, weight)
    points = robust(cameras, _flat(sided), _flat(weight))
    return Corrected(
        sided, weight, np.dstack([flips, swapped]), left_out, points
    )


def with_parts(uv: Float, weight: Float) -> tuple[Float, Float]:
    """Detections whose wrists, knuckles, eyes and mouth are those of hands and face.

    Detectors of hands and faces see them better than that of the body. Where two cameras see the
    part, the body's own joint is not used in the others.

    Args:
        uv: ``[C, F, J, 2]`` pixels.
        weight: ``[C, F, J]`` their confidence.
    """
    uv = uv.copy()
    weight = weight.copy()
    joints = list(FROM_PARTS)
    parts = list(FROM_PARTS.values())
    replaced = (weight[:, :, parts] > 0).sum(0) >= MIN_VIEWS
    uv[:, :, joints] = np.where(
        replaced[..., None], uv[:, :, parts], uv[:, :, joints]
    )
    weight[:, :, joints] = np.where(
        replaced, weight[:, :, parts], weight[:, :, joints]
    )
    return uv, weight


def body_joints(
    cameras: CameraArray,
    uv: Float,
    weight: Float,
    p: Float,
    time: Float,
    noise: float,
) -> Float:
    """The joints ``[F, 33, 3]`` of one body in smooth motion (`gsgan.prepare.many_views`).

    Args:
        cameras: ``C`` cameras.
        uv: ``[C, F, J, 2]`` undistorted pixels.
        weight: ``[C, F, J]`` their confidence.
        p: ``[F, J, 3]`` triangulated; NaN = missing.
        time: ``[F]`` seconds.
        noise: standard deviation of a landmark, pixels.
    """
    seen = weight[:, :, :BODY] > 0
    views = Views(
        K=torch.from_numpy(cameras.K),
        R=torch.from_numpy(cameras.R),
        t=torch.from_numpy(cameras.t),
        uv=torch.from_numpy(np.where(seen[..., None], uv[:, :, :BODY], 0.0)),
        weight=torch.from_numpy(np.where(seen, weight[:, :, :BODY], 0.0)),
        noise=noise,
        p=torch.from_numpy(p[:, :BODY]),
        time=torch.from_numpy(time),
    )
    return solve_views(views).numpy()


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
