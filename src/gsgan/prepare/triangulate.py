"""Triangulation from several cameras, robust against wrong detections and swapped sides."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gsgan.data.crop import NEAR
from gsgan.data.joints import known
from gsgan.prepare.camera_array import MIN_VIEWS, CameraArray
from gsgan.utils.arrays import Bool, Float, Ints, nanmedian

# Errors are in thousandths of the focal length: pixels, at a focal length of 1000 pixels.
SCALE = 3.5  # error at which a detection counts half (Cauchy's weight)
MAX_ERROR = 35.0  # median error beyond which detections contradict each other
# a point's uncertainty along over across the rays; more: too parallel
MAX_ELONGATION = 20.0
# mean loss per detection that a swap must save; an error of SCALE costs 0.7
FLIP_GAIN = 0.15
FAR = 1e6  # pixels: stands for an infinite error
FLAT = 1e-15  # determinant over trace³: below it the equations are singular in float64
# of reweighting; the search for swapped sides needs fewer
ITERATIONS = 10
QUICK_ITERATIONS = 3
CHUNK = 100_000  # points processed at once: bounds the memory, changes nothing else
MAX_PAIRS = 60  # of cameras, tried as a start; of more, a spread-out part
# of a group: hips at the border of an image do not tell left from right
LEAST_JOINTS = 3
PROGRESSION = 7919  # a prime: spreads the chosen camera pairs when there are too many

Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Triangulated:
    """Triangulated points."""

    p: Float  # [N, 3] metres, NaN where missing
    weight: Float  # [C, N] final weight of each detection, 0 where it was not used
    # [C, N] reprojection error in undistorted pixels, NaN where nothing was seen
    error: Float


def plain(cameras: CameraArray, uv: Float, weight: Float) -> Float:
    """``[N, 3]`` the weighted linear (DLT) solution, NaN with fewer than two weighted views.

    Args:
        cameras: ``C`` cameras.
        uv: ``[C, N, 2]`` undistorted pixels, NaN allowed where the weight is 0.
        weight: ``[C, N]`` confidence, at least 0.
    """
    return _solve(*_rows(cameras, uv, weight), weight)[0]


def robust(
    cameras: CameraArray,
    uv: Float,
    weight: Float,
    iterations: int = ITERATIONS,
    max_error: float = MAX_ERROR,
) -> Triangulated:
    """Triangulated that most detections agree on, by reweighting from the best pair of cameras.

    Convention: the loss is Cauchy's, ``log(1 + (r/SCALE)²)`` of the reprojection error r, times
    the weight; errors are in thousandths of the focal length. A point is NaN with fewer than two
    weighted views, with rays too parallel (`MAX_ELONGATION`), or when its detections contradict
    each other (``max_error``). Arguments as for `plain`; ``iterations`` of reweighting.
    """
    chunks = [slice(at, at + CHUNK) for at in range(0, max(uv.shape[1], 1), CHUNK)]
    parts = [
        _robust(cameras, uv[:, at], weight[:, at], iterations, max_error)
        for at in chunks
    ]
    return Triangulated(
        p=np.concatenate([part.p for part in parts]),
        weight=np.concatenate([part.weight for part in parts], axis=1),
        error=np.concatenate([part.error for part in parts], axis=1),
    )


def _robust(
    cameras: CameraArray, uv: Float, weight: Float, iterations: int, max_error: float
) -> Triangulated:
    weight = np.where(known(uv), weight, 0.0)
    a, b = _rows(cameras, uv, weight)
    p = _best_pair(cameras, uv, weight, a, b)
    reweighted = weight
    information = np.zeros((p.shape[0], 3, 3))
    for _ in range(iterations):
        loss = 1 / (1 + (cameras.errors(p, uv) / SCALE) ** 2)
        reweighted = weight * np.nan_to_num(loss, nan=0.0)
        depth = np.maximum(cameras.project(p)[1], NEAR)
        scaled = np.nan_to_num(reweighted / depth**2)  # rows are depth times pixels
        new, information = _solve(a, b, scaled)
        p = np.where(np.isfinite(new), new, p)
    error = cameras.errors(p, uv)
    certainty = np.linalg.eigvalsh(information)
    missing = certainty[:, 0] * MAX_ELONGATION**2 < certainty[:, 2]
    used = np.where(weight > 0, np.nan_to_num(error, nan=np.nan, posinf=FAR), np.nan)
    missing |= nanmedian(used) > max_error
    missing |= (weight > 0).sum(0) < MIN_VIEWS
    p = np.where(missing[:, None], np.nan, p)
    return Triangulated(
        p, np.where(missing, 0.0, reweighted), np.where(missing, np.nan, error)
    )


def robust_cost(error: Float, weight: Float) -> Float:
    """``[N]`` weighted Cauchy loss over the cameras, of ``error`` and ``weight [C, N]``.

    Detections with weight 0 cost nothing; a point that was not found costs as one far away.
    """
    far = np.nan_to_num(error, nan=FAR, posinf=FAR)
    return (np.log1p((far / SCALE) ** 2) * weight).sum(0)


def _rows(cameras: CameraArray, uv: Float, weight: Float) -> tuple[Float, Float]:
    """``a [C, N, 2, 3]``, ``b [C, N, 2]``: ``a·X - b`` is depth times the error in pixels."""
    uv = np.where((weight > 0)[..., None], uv, 0.0)
    KR = cameras.K @ cameras.R
    Kt = np.einsum("cij,cj->ci", cameras.K, cameras.t)
    a = uv[..., None] * KR[:, None, 2:] - KR[:, None, :2]
    return a, Kt[:, None, :2] - uv * Kt[:, None, 2:]


def _solve(a: Float, b: Float, weight: Float) -> tuple[Float, Float]:
    """Least squares ``[N, 3]``, NaN where views are too few, and its information ``[N, 3, 3]``."""
    w = weight[..., None]
    information = np.einsum("cnki,cnkj->nij", a * w[..., None], a)
    right = np.einsum("cnki,cnk->ni", a, b * w)
    size = np.einsum("nii->n", information)
    regular = np.linalg.det(information) > FLAT * size**3
    enough = ((weight > 0).sum(0) >= MIN_VIEWS) & regular
    safe = np.where(enough[:, None, None], information, np.eye(3))
    p = np.linalg.solve(safe, right[..., None])[..., 0]
    return np.where(enough[:, None], p, np.nan), information


def _best_pair(
    cameras: CameraArray, uv: Float, weight: Float, a: Float, b: Float
) -> Float:
    """``[N, 3]`` of all pairs' points and the linear one, that with the smallest robust cost."""
    best = _solve(a, b, weight)[0]
    cost = robust_cost(cameras.errors(best, uv), weight)
    pairs = list(combinations(range(len(cameras)), 2))
    if len(pairs) > MAX_PAIRS:
        pairs = [pairs[k * PROGRESSION % len(pairs)] for k in range(MAX_PAIRS)]
    for pair in map(list, pairs):
        p = _solve(a[pair], b[pair], weight[pair])[0]
        new = robust_cost(cameras.errors(p, uv), weight)
        better = (new < cost) & np.isfinite(p).all(-1)
        best = np.where(better[:, None], p, best)
        cost = np.where(better, new, cost)
    return best


def find_flips(
    cameras: CameraArray, uv: Float, weight: Float, groups: Sequence[Pairs]
) -> Bool:
    """``[C, F, G]`` which camera swapped which group of joints in which frame.

    Detectors confuse left and right, mostly when a person is seen from behind. Per frame, one
    camera at a time is changed as long as the triangulated points fit better. That does not
    determine whether all cameras swapped or none; the smaller motion from frame to frame and, over
    the whole sequence, the majority of the detections do.

    Args:
        cameras: ``C`` cameras.
        uv, weight: ``[C, F, J, 2]`` undistorted pixels and their confidence.
        groups: ``G`` tuples of (left, right) joints that swap together.
    """
    return np.stack(
        [_group_flips(cameras, uv, weight, pairs) for pairs in groups], axis=-1
    )


def apply_flips(values: Float, flips: Bool, groups: Sequence[Pairs]) -> Float:
    """Values ``[C, F, J, ...]`` with left and right exchanged where ``flips [C, F, G]``."""
    out = values.copy()
    for g, pairs in enumerate(groups):
        at = flips[..., g].reshape(*flips.shape[:2], *[1] * (values.ndim - 2))
        left, right = (list(side) for side in zip(*pairs, strict=True))
        for a, b in ((left, right), (right, left)):
            out[:, :, a] = np.where(at, values[:, :, b], values[:, :, a])
    return out


def points_and_cost(
    cameras: CameraArray, uv: Float, weight: Float
) -> tuple[Float, Float]:
    """``p [F, J, 3]`` of ``uv [C, F, J, 2]`` and ``weight [C, F, J]``, and its cost ``[F]``."""
    C, F, J = weight.shape
    flat = weight.reshape(C, -1)
    found = robust(cameras, uv.reshape(C, -1, 2), flat, QUICK_ITERATIONS, np.inf)
    seen = np.where(np.isfinite(found.error), flat, 0.0)
    cost = robust_cost(found.error, seen)
    return found.p.reshape(F, J, 3), cost.reshape(F, J).sum(-1)


def _group_flips(cameras: CameraArray, uv: Float, weight: Float, pairs: Pairs) -> Bool:
    """``[C, F]`` for one group."""
    joints = [j for pair in pairs for j in pair]  # pairs are then adjacent: j and j ^ 1
    local = [tuple((2 * i, 2 * i + 1) for i in range(len(pairs)))]
    uv = uv[:, :, joints]
    weight = weight[:, :, joints]
    C, F, _ = weight.shape
    everywhere = np.arange(F)

    def points(flips: Bool, frames: Ints) -> tuple[Float, Float]:
        sided = apply_flips(uv[:, frames], flips[..., None], local)
        seen = apply_flips(weight[:, frames], flips[..., None], local)
        return points_and_cost(cameras, sided, seen)

    few = (weight > 0).sum(-1) < LEAST_JOINTS
    price = np.where(few, np.inf, FLIP_GAIN * weight.sum(-1))
    flips = cheapest_flips(
        lambda f, at: points(f, at)[1], np.zeros((C, F), bool), price
    )
    flips = flips ^ exchanged(points(flips, everywhere)[0])
    votes = weight.sum(-1)
    return ~flips if (votes * flips).sum() > votes.sum() / 2 else flips


def cheapest_flips(
    cost_of: Callable[[Bool, Ints], Float], flips: Bool, price: Float
) -> Bool:
    """``flips [C, F]``, one camera at a time changed as long as that saves more than its price.

    Args:
        cost_of: cost ``[f]`` of flips ``[C, f]`` in these ``f`` frames.
        flips: to start from.
        price: ``[C, F]`` that a change must save.
    """
    C, F = flips.shape
    flips = flips.copy()
    active = np.arange(F)
    toggles = np.eye(C, dtype=bool)[:, :, None]
    cost = cost_of(flips, active)
    for _ in range(C):
        trials = np.stack([cost_of(flips[:, active] ^ one, active) for one in toggles])
        saved = cost[active] - trials - price[:, active]
        best = saved.argmax(0)
        better = saved.max(0) > 0
        active = active[better]
        best = best[better]
        if not len(active):
            break
        flips[best, active] ^= True
        cost[active] = trials[best, better.nonzero()[0]]
    return flips


def exchanged(p: Float) -> Bool:
    """``[F]`` frames whose sides ``p [F, J, 3]`` are exchanged against the first frame's."""
    state = np.zeros(len(p), bool)
    last = p[0]
    before = known(p[0])
    swap = [j ^ 1 for j in range(p.shape[1])]
    for f in range(1, len(p)):
        now = known(p[f])
        both = before & now & before[swap] & now[swap]
        straight = np.linalg.norm(p[f] - last, axis=-1)[both].sum()
        crossed = np.linalg.norm(p[f][swap] - last, axis=-1)[both].sum()
        state[f] = crossed < straight if both.any() else state[f - 1]
        settled, seen = (p[f][swap], now[swap]) if state[f] else (p[f], now)
        last = np.where(seen[:, None], settled, last)
        before = before | seen
    return state
