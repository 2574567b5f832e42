"""Triangulation from several cameras, robust against wrong detections."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gsgan.prepare.camera_array import MIN_VIEWS, CameraArray
from gsgan.scene import NEAR
from gsgan.skeleton.joints import is_known
from gsgan.utils.arrays import Float, nanmedian

# Errors are in thousandths of the focal length: pixels, at a focal length of 1000 pixels.
# error at which a detection counts half (Cauchy's weight)
HALF_WEIGHT_ERROR = 3.5
# median error beyond which detections contradict each other
MAX_MEDIAN_ERROR = 35.0
# maximum ratio of a point's uncertainty along the rays to that across: above, they are too parallel
MAX_ELONGATION = 20.0
FAR_ERROR = 1e6  # pixels: stands for an infinite error
MIN_DETERMINANT = 1e-15  # determinant over trace³: below it the equations are singular in float64
ITERATIONS = 10  # of reweighting
QUICK_ITERATIONS = 3  # of reweighting, in the search for swapped sides
# points processed at once: bounds the memory, changes nothing else
POINTS_AT_ONCE = 100_000
MAX_PAIRS = 60  # pairs of cameras tried as a start; of more, a spread-out part
# a prime: spreads the chosen camera pairs when there are too many
PROGRESSION = 7919


@dataclass(frozen=True)
class Triangulated:
    """Triangulated points."""

    p: Float  # [N, 3] metres, NaN = missing
    weight: Float  # [C, N] final weight of each detection, 0 = not used
    # [C, N] reprojection error in undistorted pixels, NaN = not seen
    error: Float


def plain(cameras: CameraArray, uv: Float, weight: Float) -> Float:
    """The weighted linear (DLT) solution ``[N, 3]``, NaN with fewer than two weighted views.

    Args:
        cameras: ``C`` cameras.
        uv: ``[C, N, 2]`` undistorted pixels, NaN allowed where the weight is 0.
        weight: ``[C, N]`` confidence, minimum 0.
    """
    a, b = _rows(cameras, uv, weight)
    p, _ = _solve(a, b, weight)
    return p


def robust(
    cameras: CameraArray,
    uv: Float,
    weight: Float,
    iterations: int = ITERATIONS,
    max_error: float = MAX_MEDIAN_ERROR,
) -> Triangulated:
    """Robust triangulation: starts from the best camera pair, then reweights iteratively.

    The loss of a reprojection error r is Cauchy's, ``log(1 + (r/s)²)`` with s `HALF_WEIGHT_ERROR`,
    times the weight; errors are in thousandths of the focal length. A point is NaN with fewer than
    two weighted views, with rays too parallel (`MAX_ELONGATION`), or if its detections contradict
    each other (``max_error``).

    Args:
        cameras: ``C`` cameras.
        uv: ``[C, N, 2]`` undistorted pixels, NaN allowed where the weight is 0.
        weight: ``[C, N]`` confidence, minimum 0.
        iterations: of reweighting.
        max_error: maximum median error of a point.
    """
    # Points do not depend on each other.
    p = []
    weights = []
    errors = []
    for start in range(0, max(uv.shape[1], 1), POINTS_AT_ONCE):
        at = slice(start, start + POINTS_AT_ONCE)
        part = _robust(cameras, uv[:, at], weight[:, at], iterations, max_error)
        p.append(part.p)
        weights.append(part.weight)
        errors.append(part.error)
    return Triangulated(
        p=np.concatenate(p),
        weight=np.concatenate(weights, axis=1),
        error=np.concatenate(errors, axis=1),
    )


def _robust(
    cameras: CameraArray,
    uv: Float,
    weight: Float,
    iterations: int,
    max_error: float,
) -> Triangulated:
    # A start that a few wrong detections do not spoil.
    weight = np.where(is_known(uv), weight, 0.0)
    a, b = _rows(cameras, uv, weight)
    p = _best_pair(cameras, uv, weight, a, b)

    # Rows are depth times pixels: dividing their squares by depth² gives pixels.
    reweighted = weight
    information = np.zeros((p.shape[0], 3, 3))
    for _ in range(iterations):
        # Points that are not found yet keep a weight of 0.
        cauchy = 1 / (1 + (cameras.errors(p, uv) / HALF_WEIGHT_ERROR) ** 2)
        reweighted = weight * np.nan_to_num(cauchy, nan=0.0)
        _, depth = cameras.project(p)
        scaled = np.nan_to_num(reweighted / np.maximum(depth, NEAR) ** 2)
        new, information = _solve(a, b, scaled)
        p = np.where(np.isfinite(new), new, p)

    # Points with parallel rays: eigenvalues of the information are inverse variances.
    certainty = np.linalg.eigvalsh(information)
    missing = certainty[:, 0] * MAX_ELONGATION**2 < certainty[:, 2]

    # Points with contradicting detections or too few views.
    error = cameras.errors(p, uv)
    finite = np.nan_to_num(error, nan=np.nan, posinf=FAR_ERROR)
    used = np.where(weight > 0, finite, np.nan)
    missing |= nanmedian(used) > max_error
    missing |= (weight > 0).sum(0) < MIN_VIEWS
    return Triangulated(
        p=np.where(missing[:, None], np.nan, p),
        weight=np.where(missing, 0.0, reweighted),
        error=np.where(missing, np.nan, error),
    )


def robust_cost(error: Float, weight: Float) -> Float:
    """The weighted Cauchy loss ``[N]`` over the cameras, of ``error`` and ``weight [C, N]``.

    Detections with weight 0 cost nothing; a point that was not found costs as one far away.
    """
    far = np.nan_to_num(error, nan=FAR_ERROR, posinf=FAR_ERROR)
    return (np.log1p((far / HALF_WEIGHT_ERROR) ** 2) * weight).sum(0)


def _rows(
    cameras: CameraArray, uv: Float, weight: Float
) -> tuple[Float, Float]:
    """The rows ``a [C, N, 2, 3]`` and ``b [C, N, 2]`` of linear equations.

    With ``K R X + K t = (x, y, z)``, z being the depth, the error in pixels is ``u - x / z``;
    times z it is linear in X: ``a·X - b``.
    """
    # Detections that are not used may be NaN.
    uv = np.where((weight > 0)[..., None], uv, 0.0)

    # The first two rows of K [R t], less the third times the pixel.
    KR = (cameras.K @ cameras.R)[:, None]
    Kt = np.einsum("cij,cj->ci", cameras.K, cameras.t)[:, None]
    a = uv[..., None] * KR[:, :, 2:] - KR[:, :, :2]
    b = Kt[:, :, :2] - uv * Kt[:, :, 2:]
    return a, b


def _solve(a: Float, b: Float, weight: Float) -> tuple[Float, Float]:
    """Least squares ``[N, 3]``, NaN if views are too few, and its information ``[N, 3, 3]``."""
    # Normal equations, singular if the rays are parallel.
    w = weight[..., None]
    information = np.einsum("cnki,cnkj->nij", a * w[..., None], a)
    right = np.einsum("cnki,cnk->ni", a, b * w)
    size = np.einsum("nii->n", information)
    regular = np.linalg.det(information) > MIN_DETERMINANT * size**3

    # Singular systems are replaced by the identity, and their result by NaN.
    enough = ((weight > 0).sum(0) >= MIN_VIEWS) & regular
    safe = np.where(enough[:, None, None], information, np.eye(3))
    p = np.linalg.solve(safe, right[..., None])[..., 0]
    return np.where(enough[:, None], p, np.nan), information


def _best_pair(
    cameras: CameraArray,
    uv: Float,
    weight: Float,
    a: Float,
    b: Float,
) -> Float:
    """The points ``[N, 3]`` with the smallest robust cost: of a camera pair, or linear from all."""
    # The linear solution of all cameras is the first candidate.
    best, _ = _solve(a, b, weight)
    cost = robust_cost(cameras.errors(best, uv), weight)

    # A detection that is wrong in one camera spoils the pairs with that camera
    # only.
    pairs = [list(pair) for pair in combinations(range(len(cameras)), 2)]
    if len(pairs) > MAX_PAIRS:
        pairs = [pairs[k * PROGRESSION % len(pairs)] for k in range(MAX_PAIRS)]

    # Each pair's point replaces the best one so far if it fits all cameras better.
    for pair in pairs:
        p, _ = _solve(a[pair], b[pair], weight[pair])
        new = robust_cost(cameras.errors(p, uv), weight)
        better = (new < cost) & np.isfinite(p).all(-1)
        best = np.where(better[:, None], p, best)
        cost = np.where(better, new, cost)
    return best


def points_and_cost(
    cameras: CameraArray,
    uv: Float,
    weight: Float,
) -> tuple[Float, Float]:
    """Points ``[F, J, 3]`` of ``uv [C, F, J, 2]``, ``weight [C, F, J]``, and their cost ``[F]``."""
    # Frames and joints are points like any others.
    C, F, J = weight.shape
    flat = weight.reshape(C, -1)
    result = robust(
        cameras, uv.reshape(C, -1, 2), flat, QUICK_ITERATIONS, np.inf
    )

    # Points that were not found cost nothing here: they would favour no side.
    seen = np.where(np.isfinite(result.error), flat, 0.0)
    cost = robust_cost(result.error, seen)
    return result.p.reshape(F, J, 3), cost.reshape(F, J).sum(-1)
