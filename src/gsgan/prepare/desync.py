"""By how many frames each camera's clock is off, told from the motion."""

from __future__ import annotations

import numpy as np

from gsgan.prepare.rig import Float, Rig
from gsgan.prepare.solve import median
from gsgan.prepare.triangulate import MIN_VIEWS, Triangulation


def clock_errors(
    rig: Rig, uv: Float, weight: Float, triangulation: Triangulation, lag: int
) -> tuple[Float, Float]:
    """Each camera's delay against the others, and how much setting it right would gain.

    Convention: frames; a positive delay means that the camera shows a moment later than the others
    at the same number, so its numbers should grow by that much. Points are made without the camera,
    so it takes three; with two the delay is NaN. Between frames a parabola through the three best
    lags decides.

    Args:
        rig: ``C`` cameras.
        uv: ``[C, F, J, 2]`` undistorted pixels.
        weight: ``[C, F, J]``.
        triangulation: how points are made.
        lag: frames tried either way.

    Returns:
        ``delay [C]`` and ``gain [C]``, the share by which the median error falls.
    """
    C, F, J = weight.shape
    delay, gain = np.full(C, np.nan), np.full(C, np.nan)
    lag = min(lag, F - 1)
    rig, uv = rig.normalised(uv)
    if C <= MIN_VIEWS or lag < 1:
        return delay, gain
    for c in range(C):
        others = np.arange(C) != c
        p = triangulation.points(
            rig.without(c), uv[others].reshape(C - 1, -1, 2), weight[others].reshape(C - 1, -1)
        ).p
        there = rig.project(p)[0][c].reshape(F, J, 2)
        seen = np.where((weight[c] > 0)[..., None], uv[c], np.nan)
        errors = np.array([_shifted_error(there, seen, s) for s in range(-lag, lag + 1)])
        if np.isfinite(errors[lag]):
            delay[c], gain[c] = _minimum(errors, lag)
    return delay, gain


def _shifted_error(there: Float, seen: Float, shift: int) -> float:
    """Median error in pixels when the camera's frame f shows the others' frame f - shift."""
    F = len(there)
    ours, theirs = (
        seen[max(shift, 0) : F + min(shift, 0)],
        there[max(-shift, 0) : F - max(shift, 0)],
    )
    return median(np.linalg.norm(ours - theirs, axis=-1))


def _minimum(errors: Float, lag: int) -> tuple[float, float]:
    best = int(np.nanargmin(errors))
    gain = 1 - errors[best] / max(errors[lag], 1e-12)
    step = 0.0
    if 0 < best < len(errors) - 1:
        before, here, after = errors[best - 1 : best + 2]
        bend = before - 2 * here + after
        if np.isfinite(bend) and bend > 0:
            step = 0.5 * (before - after) / bend
    return lag - best - step, float(gain)
