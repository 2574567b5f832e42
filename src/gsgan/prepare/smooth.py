"""Trajectories made smooth in time, by a local parabola that knows of gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsgan.prepare.rig import Float
from gsgan.utils.errors import ConfigError

DEGREE = 2
REACH = 3  # the kernel ends at this many of its widths


@dataclass(frozen=True)
class Smoothing:
    """How trajectories are smoothed.

    Args:
        seconds: standard deviation of the Gaussian that weighs neighbouring moments; 0 leaves the
            points as triangulated.

    Raises:
        ConfigError: when it is negative.
    """

    seconds: float = 0.02

    def __post_init__(self) -> None:
        if not self.seconds >= 0:
            raise ConfigError(f"smoothing.seconds must be at least 0, got {self.seconds!r}")


def smooth(p: Float, weight: Float, time: Float, seconds: float) -> Float:
    """Each point replaced by the parabola fitted to its neighbourhood in time.

    Convention: a missing point (NaN, or weight 0) stays NaN and counts for nothing; a motion with
    constant acceleration comes back unchanged, gaps or not. Where fewer than three moments are
    near, the point is left as it was.

    Args:
        p: ``[F, J, 3]`` metres, NaN = missing.
        weight: ``[F, J]`` how far each is trusted, at least 0.
        time: ``[F]`` seconds, rising; it need not be even.
        seconds: standard deviation of the Gaussian neighbourhood.
    """
    known = np.isfinite(p).all(-1) & (weight > 0)
    filled, weight = np.where(known[..., None], p, 0.0), np.where(known, weight, 0.0)
    out = np.where(known[..., None], p, np.nan)
    if seconds == 0:
        return out
    for f, now in enumerate(time):
        near = np.abs(time - now) <= REACH * seconds
        s = (time[near] - now) / seconds
        basis = s[:, None] ** np.arange(DEGREE + 1)
        w = np.exp(-0.5 * s**2)[:, None] * weight[near]
        enough = known[f] & (known[near].sum(0) > DEGREE)
        normal = np.einsum("fj,fa,fb->jab", w, basis, basis)
        right = np.einsum("fj,fa,fjx->jax", w, basis, filled[near])
        normal[~enough] = np.eye(DEGREE + 1)
        fitted = np.linalg.solve(normal, right)[:, 0]
        out[f] = np.where(enough[:, None], fitted, out[f])
    return out
