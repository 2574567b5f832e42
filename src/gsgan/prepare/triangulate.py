"""Triangulation from several cameras: linear, and robust against wrong detections."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gsgan.data.crop import NEAR
from gsgan.prepare.rig import Bool, Float, Rig, known
from gsgan.utils.errors import ConfigError

MIN_VIEWS = 2
FAR = 1e6  # pixels: stands for an infinite error
FLAT = 1e-15  # determinant over trace³: below it the equations are singular in float64
POSITIVE = ("scale", "iterations", "max_pairs", "max_elongation", "max_error", "chunk")
PROGRESSION = 7919  # a prime: spreads the chosen camera pairs when there are too many


@dataclass(frozen=True)
class Points:
    """Triangulated points.

    Args:
        p: ``[N, 3]`` metres, NaN where missing.
        weight: ``[C, N]`` final weight of each detection, 0 where it was not used.
        error: ``[C, N]`` reprojection error in undistorted pixels, NaN where nothing was seen.
    """

    p: Float
    weight: Float
    error: Float


@dataclass(frozen=True)
class Triangulation:
    """Settings of the triangulation, see conf/prepare.yaml.

    Errors are in thousandths of the focal length: pixels, at a focal length of 1000 pixels.

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
        for name in POSITIVE:
            if not getattr(self, name) > 0:
                raise ConfigError(
                    f"triangulation.{name} must be above 0, got {getattr(self, name)!r}"
                )

    def plain(self, rig: Rig, uv: Float, weight: Float) -> Float:
        """The weighted linear (DLT) solution, without outlier rejection.

        Args:
            rig: ``C`` cameras.
            uv: ``[C, N, 2]`` undistorted pixels; ignored where the weight is 0.
            weight: ``[C, N]`` at least 0.

        Returns:
            ``[N, 3]`` metres, NaN where fewer than two cameras have a weight.
        """
        parts = self._chunks(uv, weight)
        return np.concatenate([_solve(*_rows(rig, u, w), w)[0] for u, w in parts])

    def points(self, rig: Rig, uv: Float, weight: Float) -> Points:
        """Points that most detections agree on, by reweighting from the best pair of cameras.

        Convention: the loss is Cauchy's, ``log(1 + (r/scale)²)`` of the reprojection error r, times
        the weight. A point is NaN with fewer than two weighted views, with rays too parallel
        (``max_elongation``), or when its detections contradict each other (``max_error``).

        Args:
            rig: ``C`` cameras.
            uv: ``[C, N, 2]`` undistorted pixels, NaN allowed where the weight is 0.
            weight: ``[C, N]`` confidence, at least 0.
        """
        parts = [_robust(rig, *part, self) for part in self._chunks(uv, weight)]
        return Points(
            p=np.concatenate([part.p for part in parts]),
            weight=np.concatenate([part.weight for part in parts], axis=1),
            error=np.concatenate([part.error for part in parts], axis=1),
        )

    def _chunks(self, uv: Float, weight: Float) -> Iterator[tuple[Float, Float]]:
        for start in range(0, max(uv.shape[1], 1), self.chunk):
            part = slice(start, start + self.chunk)
            yield uv[:, part], weight[:, part]


def _robust(rig: Rig, uv: Float, weight: Float, settings: Triangulation) -> Points:
    weight = np.where(known(uv) & (weight > settings.min_confidence), weight, 0.0)
    a, b = _rows(rig, uv, weight)
    p, reweighted = _best_pair(rig, uv, weight, a, b, settings), weight
    information = np.zeros((p.shape[0], 3, 3))
    for _ in range(settings.iterations):
        loss = 1 / (1 + (rig.errors(p, uv) / settings.scale) ** 2)
        reweighted = weight * np.nan_to_num(loss, nan=0.0)
        depth = np.maximum(rig.project(p)[1], NEAR)
        scaled = np.nan_to_num(reweighted / depth**2)  # rows are depth times pixels
        new, information = _solve(a, b, scaled)
        p = np.where(np.isfinite(new), new, p)
    error = rig.errors(p, uv)
    certainty = np.linalg.eigvalsh(information)
    missing = certainty[:, 0] * settings.max_elongation**2 < certainty[:, 2]
    missing |= _median(error, weight > 0) > settings.max_error
    missing |= (weight > 0).sum(0) < MIN_VIEWS
    p = np.where(missing[:, None], np.nan, p)
    return Points(p, np.where(missing, 0.0, reweighted), np.where(missing, np.nan, error))


def robust_cost(error: Float, weight: Float, scale: float) -> Float:
    """``[N]`` weighted Cauchy loss over the cameras, of ``error`` and ``weight [C, N]``.

    Detections with weight 0 cost nothing; a point that was not found costs as one far away.
    """
    far = np.nan_to_num(error, nan=FAR, posinf=FAR)
    return (np.log1p((far / scale) ** 2) * weight).sum(0)


def _rows(rig: Rig, uv: Float, weight: Float) -> tuple[Float, Float]:
    """``a [C, N, 2, 3]``, ``b [C, N, 2]``: ``a·X - b`` is depth times the error in pixels."""
    uv = np.where((weight > 0)[..., None], uv, 0.0)
    KR, Kt = rig.K @ rig.R, np.einsum("cij,cj->ci", rig.K, rig.t)
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
    rig: Rig, uv: Float, weight: Float, a: Float, b: Float, settings: Triangulation
) -> Float:
    """``[N, 3]`` of all pairs' points and the linear one, that with the smallest robust cost."""
    best = _solve(a, b, weight)[0]
    cost = robust_cost(rig.errors(best, uv), weight, settings.scale)
    pairs = list(combinations(range(len(rig)), 2))
    if len(pairs) > settings.max_pairs:
        pairs = [pairs[k * PROGRESSION % len(pairs)] for k in range(settings.max_pairs)]
    for pair in map(list, pairs):
        p = _solve(a[pair], b[pair], weight[pair])[0]
        new = robust_cost(rig.errors(p, uv), weight, settings.scale)
        better = (new < cost) & np.isfinite(p).all(-1)
        best, cost = np.where(better[:, None], p, best), np.where(better, new, cost)
    return best


def _median(error: Float, used: Bool) -> Float:
    """``[N]`` median over the used cameras, 0 where there are none."""
    masked = np.where(used, np.nan_to_num(error, nan=np.nan, posinf=FAR), np.nan)
    masked[:, np.isnan(masked).all(0)] = 0.0
    return np.asarray(np.nanmedian(masked, axis=0))
