"""Cameras without a calibration, from the person that all of them filmed at the same time.

The landmarks of one moving person are the same points in every camera. Two cameras start from the
essential matrix of their landmarks, the others are added by their view of the triangulated ones,
and a bundle adjustment finds orientations, positions and focal lengths together. The principal
point is the image's centre, and lenses have no distortion. The result has no scale.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import cv2
import numpy as np

from gsgan.data.cameras import CameraEntry
from gsgan.prepare.camera_array import (
    CameraArray,
    film_camera,
    refine_cameras,
)
from gsgan.prepare.sides import apply_flips, find_flips
from gsgan.prepare.triangulate import robust
from gsgan.skeleton.joints import BODY, FLIP_GROUPS, is_known
from gsgan.utils.arrays import Float, evenly_spaced
from gsgan.utils.errors import DataError

USED_FRAMES = 150  # maximum number of frames that are used, evenly spaced
SEEN_CONFIDENCE = 0.5  # minimum confidence of a landmark
# Millimetres on film of 36 x 24 mm: the solution starts from each of these.
START_FOCALS = (26.0, 40.0, 65.0)
# Standard deviation of the logarithm of a focal length: of an unknown and of a given one.
FOCAL_PRIOR = 0.5
GIVEN_PRIOR = 0.01
# Landmarks of a true pair agree to this distance in the plane at depth 1, which is generous because
# detectors disagree by some percent of the person's size.
MAX_DISTANCE = 0.01
MIN_COMMON = 60  # landmarks in both of two cameras, over all frames
# Between the rays of a pair: larger angles count alike.
GOOD_ANGLE = np.radians(20)
FREE_ROTATION = 180.0  # degrees: priors so wide that they only fix the world
FREE_POSITION = 10.0  # distances of the first two cameras
ROUNDS = 3  # of the bundle adjustment, with swapped sides corrected in between


class Calibrated(NamedTuple):
    """Cameras that agree with the landmarks of a person, in a world without a scale."""

    cameras: list[CameraEntry]
    error: Float  # [C] median reprojection error, pixels
    angle: float  # degrees, the median angle between the rays of a landmark


def calibrate_from_person(
    cameras: Sequence[CameraEntry],
    uv: Float,
    conf: Float,
    time: Float,
    focal: float | None,
) -> Calibrated:
    """The cameras' orientations, positions and focal lengths.

    Args:
        cameras: C cameras, of which names and sizes are used.
        uv: ``[C, F, J, 2]`` pixels of landmarks, the first 33 MediaPipe's.
        conf: ``[C, F, J]`` their confidence.
        time: ``[F]`` seconds.
        focal: of all cameras, in millimetres on film of 36 x 24 mm; None: unknown.

    Raises:
        DataError: when too few landmarks are seen by two cameras at once, they do not agree, or
            they cannot determine focal lengths.
    """
    if len(cameras) == 2 and focal is None:
        raise DataError(
            "calibration=person: a person in two cameras does not determine their focal lengths; "
            "give focal=<mm>, or a third camera"
        )

    # Frames with the person in two cameras, evenly spaced.
    uv = uv[:, :, :BODY]
    weight = np.where(
        is_known(uv) & (conf[:, :, :BODY] > SEEN_CONFIDENCE), 1.0, 0.0
    )
    shared = np.flatnonzero((weight.sum(2) > 0).sum(0) >= 2)
    frames = shared[evenly_spaced(len(shared), USED_FRAMES)]
    uv = uv[:, frames]
    weight = weight[:, frames]
    time = time[frames]

    # The solution of each start; the one whose landmarks agree best is kept. From a wrong focal
    # length it may be impossible to place a camera, which another start can.
    best = None
    failure = None
    for start in START_FOCALS if focal is None else (focal,):
        guess = [
            film_camera(camera.name, camera.size, start) for camera in cameras
        ]
        prior = FOCAL_PRIOR if focal is None else GIVEN_PRIOR
        try:
            calibrated = _solution(guess, uv, weight, time, prior)
        except DataError as error:
            failure = error
            continue
        if best is None or np.nanmean(calibrated.error) < np.nanmean(
            best.error
        ):
            best = calibrated
    if best is None:
        assert failure is not None
        raise failure
    return best


def _solution(
    guess: list[CameraEntry],
    uv: Float,
    weight: Float,
    time: Float,
    focal_prior: float,
) -> Calibrated:
    """The cameras near the focal lengths of ``guess``."""
    # In thousandths of the focal length, so that images of all sizes count alike.
    C = len(guess)
    images = CameraArray.of(guess)
    array, pixels = images.normalise(uv)
    per_image = images.focal / array.focal
    flat = pixels.reshape(C, -1, 2)
    rig = _chain(array, flat, weight.reshape(C, -1), guess)
    near = rig

    # Landmarks and cameras together. Detectors swap sides, which a first solution shows.
    sided = pixels
    seen = weight
    for _ in range(ROUNDS):
        flat = sided.reshape(C, -1, 2)
        points = robust(rig, flat, seen.reshape(C, -1)).p
        rig = refine_cameras(
            near,
            rig,
            points,
            flat,
            seen.reshape(C, -1),
            FREE_ROTATION,
            FREE_POSITION,
            focal_prior,
        )
        flips = find_flips(rig, pixels, weight, time)
        sided = apply_flips(pixels, flips, FLIP_GROUPS)
        seen = apply_flips(weight, flips, FLIP_GROUPS)

    # Errors in pixels of the images, and angles between rays.
    flat = sided.reshape(C, -1, 2)
    surface = robust(rig, flat, seen.reshape(C, -1))
    used = is_known(surface.p)
    if not used.any():
        raise DataError(
            "calibration=person: no landmark is seen alike by two cameras; do frame numbers agree?"
        )
    error = rig.errors(surface.p, flat) * per_image[:, None]
    error = np.where(seen.reshape(C, -1) > 0, error, np.nan)

    # The focal lengths, in pixels of the images.
    entries = []
    for c, camera in enumerate(guess):
        K = camera.K.copy()
        K[[0, 1], [0, 1]] = per_image[c] * rig.focal[c]
        entries.append(replace(camera, K=K, R=rig.R[c], t=rig.t[c]))
    return Calibrated(
        cameras=entries,
        error=np.nanmedian(error, axis=1),
        angle=_ray_angle(rig, surface.p[used], seen.reshape(C, -1)[:, used]),
    )


def _chain(
    array: CameraArray, uv: Float, weight: Float, guess: list[CameraEntry]
) -> CameraArray:
    """The first poses: a pair of cameras, then one camera after the other.

    Args:
        array: C cameras, of which K is used.
        uv: ``[C, N, 2]`` their pixels.
        weight: ``[C, N]``, 0 = not seen.
        guess: the cameras, for messages.
    """
    # The pair whose landmarks agree best at a good angle begins.
    rays = np.einsum("cij,cnj->cni", np.linalg.inv(array.K), _homogeneous(uv))
    rays = rays[..., :2]
    best = None
    for a, b in combinations(range(len(array)), 2):
        both = (weight[a] > 0) & (weight[b] > 0)
        if both.sum() < MIN_COMMON:
            continue
        pose = _pair(rays[a, both], rays[b, both])
        if pose is not None and (best is None or pose[0] > best[0]):
            best = (*pose, a, b)
    if best is None:
        raise DataError(
            "calibration=person: no two cameras see the person at the same time often enough "
            f"({MIN_COMMON} landmarks that agree are needed); do frame numbers agree?"
        )
    _, R_ab, t_ab, a, b = best
    R = np.tile(np.eye(3), (len(array), 1, 1))
    t = np.zeros((len(array), 3))
    R[b] = R_ab
    t[b] = t_ab
    placed = [a, b]

    # Each further camera is placed by its view of the points so far.
    while len(placed) < len(array):
        rig = replace(array, R=R, t=t)
        points = robust(rig[placed], uv[placed], weight[placed]).p
        views = {}
        for c in set(range(len(array))) - set(placed):
            both = is_known(points) & (weight[c] > 0)
            view = _locate_camera(points[both], rays[c, both])
            if view is not None:
                views[c] = view
        if not views:
            left = set(range(len(array))) - set(placed)
            names = ", ".join(guess[c].name for c in sorted(left))
            raise DataError(
                f"calibration=person: {names} cannot be placed: too few landmarks agree with the "
                "other cameras; leave them out, or correct their clocks (offsets)"
            )
        c = max(views, key=lambda camera: views[camera][0])
        _, R[c], t[c] = views[c]
        placed.append(c)
    return replace(array, R=R, t=t)


def _pair(x: Float, y: Float) -> tuple[float, Float, Float] | None:
    """How well two cameras agree, and the second's R and t (of length 1) from the first.

    Args:
        x, y: ``[N, 2]`` rays at depth 1 of the same landmarks.
    """
    E, inside = cv2.findEssentialMat(
        x, y, np.eye(3), cv2.RANSAC, 0.999, MAX_DISTANCE
    )
    if E is None or E.shape != (3, 3):
        return None
    count, R, t, _ = cv2.recoverPose(E, x, y, np.eye(3), mask=inside)
    if count < MIN_COMMON:
        return None

    # Nearly parallel rays determine no depth.
    kept = inside.ravel() > 0
    first = _unit(_homogeneous(x[kept]))
    second = _unit(_homogeneous(y[kept])) @ R
    angle = np.median(np.arccos((first * second).sum(-1).clip(-1, 1)))
    score = count * min(1.0, float(np.sin(angle) / np.sin(GOOD_ANGLE)))
    return score, np.asarray(R, np.float64), np.ravel(t)


def _locate_camera(
    points: Float, rays: Float
) -> tuple[int, Float, Float] | None:
    """How many points agree with a camera's rays at depth 1, and its R and t."""
    if len(points) < MIN_COMMON:
        return None
    done, turn, t, inside = cv2.solvePnPRansac(
        points,
        rays,
        np.eye(3),
        None,
        iterationsCount=1000,
        reprojectionError=2 * MAX_DISTANCE,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not done or inside is None or len(inside) < MIN_COMMON:
        return None
    R, _ = cv2.Rodrigues(turn)
    return len(inside), np.asarray(R, np.float64), np.ravel(t)


def _ray_angle(rig: CameraArray, points: Float, weight: Float) -> float:
    """The median over points of the largest angle between two of their rays, degrees."""
    rays = _unit(points - rig.centres[:, None])
    largest = np.zeros(len(points))
    for a, b in combinations(range(len(rig)), 2):
        cosine = (rays[a] * rays[b]).sum(-1).clip(-1, 1)
        both = (weight[a] > 0) & (weight[b] > 0)
        largest = np.maximum(largest, np.where(both, np.arccos(cosine), 0.0))
    return float(np.degrees(np.median(largest)))


def _homogeneous(x: Float) -> Float:
    return np.concatenate([x, np.ones_like(x[..., :1])], axis=-1)


def _unit(x: Float) -> Float:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)
