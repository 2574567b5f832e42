"""Points from what several cameras saw of them: weighted, and robust against wrong detections."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gsgan.data.crop import NEAR
from gsgan.prepare.rig import Bool, Float, Rig
from gsgan.utils.errors import ConfigError

MIN_VIEWS = 2
FAR = 1e6  # pixels: stands for an infinite error
FLAT = 1e-15  # determinant over trace³: below it the equations are singular in float64
LIMITS = ("max_elongation", "max_error")
PROGRESSION = 7919  # a prime: takes a spread-out part of the camera pairs when there are too many


@dataclass(frozen=True)
class Triangulation:
    """How points are found from detections.

    Errors are in thousandths of the focal length: pixels, at a focal length of 1000 pixels.

    Args:
        min_confidence: a detection at or below it is not used.
        scale: error at which a detection counts half (Cauchy's weight).
        iterations: of reweighting.
        max_pairs: pairs of cameras tried as a start; with more cameras a spread-out part of them.
        max_elongation: how many times further off a point may be in its least certain direction
            than in its most certain; beyond it the rays are too parallel and it is missing.
        max_error: a point whose detections lie further off, in their median, is missing.
        chunk: points worked on at once, which bounds memory; the result is the same.

    Raises:
        ConfigError: when a value is out of its range.
    """

    min_confidence: float = 0.1
    scale: float = 3.5
    iterations: int = 10
    max_pairs: int = 60
    max_elongation: float = 20.0
    max_error: float = 35.0
    chunk: int = 100_000

    def __post_init__(self) -> None:
        for name in (*("scale", "iterations", "max_pairs"), *LIMITS, "chunk"):
            if not getattr(self, name) > 0:
                raise ConfigError(
                    f"triangulation.{name} must be above 0, got {getattr(self, name)!r}"
                )

    def points(self, rig: Rig, uv: Float, weight: Float) -> Points:
        """Robust points, see `robust_points`, chunk by chunk."""
        starts = range(0, max(uv.shape[1], 1), self.chunk)
        parts = [
            robust_points(rig, uv[:, i : i + self.chunk], weight[:, i : i + self.chunk], self)
            for i in starts
        ]
        return Points(
            p=np.concatenate([part.p for part in parts]),
            weight=np.concatenate([part.weight for part in parts], axis=1),
            error=np.concatenate([part.error for part in parts], axis=1),
        )

    def plain(self, rig: Rig, uv: Float, weight: Float) -> Float:
        """Plain points ``[N, 3]``, see `linear_points`, chunk by chunk."""
        starts = range(0, max(uv.shape[1], 1), self.chunk)
        return np.concatenate(
            [
                linear_points(rig, uv[:, i : i + self.chunk], weight[:, i : i + self.chunk])
                for i in starts
            ]
        )


@dataclass(frozen=True)
class Points:
    """Triangulated points.

    Args:
        p: ``[N, 3]`` metres, NaN where missing.
        weight: ``[C, N]`` what each detection counted for, 0 where it was not used.
        error: ``[C, N]`` reprojection error in undistorted pixels, NaN where nothing was seen.
    """

    p: Float
    weight: Float
    error: Float


def linear_points(rig: Rig, uv: Float, weight: Float) -> Float:
    """The plain weighted linear (DLT) solution: no outlier is told from the rest.

    Args:
        rig: ``C`` cameras.
        uv: ``[C, N, 2]`` undistorted pixels; anything where the weight is 0.
        weight: ``[C, N]`` at least 0.

    Returns:
        ``[N, 3]`` metres, NaN where fewer than two cameras have a weight.
    """
    a, b = _rows(rig, uv, weight)
    return _solve(a, b, weight)[0]


def robust_points(rig: Rig, uv: Float, weight: Float, settings: Triangulation) -> Points:
    """Points that most detections agree on, by reweighting from the best pair of cameras.

    Convention: the loss is Cauchy's, ``log(1 + (r/scale)²)`` of the reprojection error r, times the
    weight. A point is NaN with fewer than two weighted views, with rays too parallel
    (``max_elongation``), or when its detections contradict each other (``max_error``).

    Args:
        rig: ``C`` cameras.
        uv: ``[C, N, 2]`` undistorted pixels, NaN allowed where the weight is 0.
        weight: ``[C, N]`` confidence, at least 0.
        settings: scale and limits.
    """
    weight = np.where(np.isfinite(uv).all(-1) & (weight > settings.min_confidence), weight, 0.0)
    a, b = _rows(rig, uv, weight)
    p, reweighted = _best_pair(rig, uv, weight, a, b, settings), weight
    information = np.zeros((p.shape[0], 3, 3))
    for _ in range(settings.iterations):
        reweighted = weight * _cauchy(rig.errors(p, uv), settings.scale)
        depth = np.maximum(rig.project(p)[1], NEAR)
        scaled = np.nan_to_num(reweighted / depth**2)  # rows are depth times pixels
        new, information = _solve(a, b, scaled)
        p = np.where(np.isfinite(new), new, p)
    error = rig.errors(p, uv)
    missing = _too_long(information, settings.max_elongation)
    missing |= _median(error, weight > 0) > settings.max_error
    missing |= (weight > 0).sum(0) < MIN_VIEWS
    p = np.where(missing[:, None], np.nan, p)
    return Points(p, np.where(missing, 0.0, reweighted), np.where(missing, np.nan, error))


def robust_cost(error: Float, weight: Float, scale: float) -> Float:
    """``[N]`` weighted Cauchy loss over the cameras; unseen detections cost nothing.

    Args:
        error: ``[C, N]`` pixels.
        weight: ``[C, N]``.
        scale: pixels.
    """
    far = np.nan_to_num(error, nan=FAR, posinf=FAR)  # a point that could not be found costs most
    return (np.log1p((far / scale) ** 2) * weight).sum(0)


def _cauchy(error: Float, scale: float) -> Float:
    return np.nan_to_num(1 / (1 + (error / scale) ** 2), nan=0.0)


def _rows(rig: Rig, uv: Float, weight: Float) -> tuple[Float, Float]:
    """``a [C, N, 2, 3]``, ``b [C, N, 2]``: ``a·X - b`` is depth times the error in pixels."""
    uv = np.where((weight > 0)[..., None], uv, 0.0)
    KR, Kt = rig.K @ rig.R, np.einsum("cij,cj->ci", rig.K, rig.t)
    a = uv[..., None] * KR[:, None, 2:] - KR[:, None, :2]
    return a, Kt[:, None, :2] - uv * Kt[:, None, 2:]


def _solve(a: Float, b: Float, weight: Float) -> tuple[Float, Float]:
    """Least squares; ``[N, 3]`` with NaN where there are too few views, and ``[N, 3, 3]``."""
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
    rig: Rig, uv: Float, weight: Float, a: Float, b: Float, settings: Triangulation
) -> Float:
    """``[N, 3]`` the pair's point that all cameras together find least wrong."""
    best = _solve(a, b, weight)[0]
    cost = robust_cost(rig.errors(best, uv), weight, settings.scale)
    for i, j in _pairs(len(rig), settings.max_pairs):
        pair = [i, j]
        p = _solve(a[pair], b[pair], weight[pair])[0]
        new = robust_cost(rig.errors(p, uv), weight, settings.scale)
        better = (new < cost) & np.isfinite(p).all(-1)
        best, cost = np.where(better[:, None], p, best), np.where(better, new, cost)
    return best


def _pairs(cameras: int, limit: int) -> list[tuple[int, int]]:
    pairs = list(combinations(range(cameras), 2))
    if len(pairs) <= limit:
        return pairs
    return [pairs[k * PROGRESSION % len(pairs)] for k in range(limit)]


def _too_long(information: Float, limit: float) -> Bool:
    """Whether a point is far less certain along the rays than across them."""
    values = np.linalg.eigvalsh(information)
    return np.asarray(values[:, 0] * limit**2 < values[:, 2])


def _median(error: Float, used: Bool) -> Float:
    """``[N]`` median over the used cameras, 0 where none is."""
    masked = np.where(used, np.nan_to_num(error, nan=np.nan, posinf=FAR), np.nan)
    masked[:, np.isnan(masked).all(0)] = 0.0
    return np.asarray(np.nanmedian(masked, axis=0))
