"""A view through a distorting lens.

Convention: OpenCV's model, on x/z and y/z of the camera's axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gsgan.data.crop import distort
from gsgan.data.synthetic.trace import View
from gsgan.utils.errors import ConfigError

Array = NDArray[np.float64]

EXACT = 1e-10  # residual of x/z up to which an undistorted point counts as found
FURTHEST = 10.0  # bound of x/z in the search


@dataclass(frozen=True)
class LensView(View):
    """A camera with lens coefficients ``dist`` ``[4, 5 or 8]``, OpenCV order."""

    dist: Array

    def project(self, points: Array) -> Array:
        """``[N, 2]`` pixels of world points ``[N, 3]``, all in front of the camera."""
        x = points @ self.R.T + self.t
        shown = distort(x[:, :2] / x[:, 2:], self.dist)
        return shown @ self.K[:2, :2].T + self.K[:2, 2]

    def bend(self, directions: Array) -> Array:
        """The world rays ``[N, 3]``, of length one, seen where a pinhole sees ``directions``.

        Raises:
            ConfigError: when the distortion cannot be inverted there.
        """
        rays = directions @ self.R.T
        straight = undistort(rays[:, :2] / rays[:, 2:], self.dist)
        rays = np.concatenate([straight, np.ones((len(rays), 1))], axis=1) @ self.R
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def undistort(points: Array, dist: Array, iterations: int = 200) -> Array:
    """The inverse of `gsgan.data.crop.distort`, exact to `EXACT`, by fixed-point iteration.

    Args:
        points: ``[N, 2]`` as the lens shows them.
        dist: lens coefficients.
        iterations: at most; each reduces the error by a factor that depends on the distortion.

    Raises:
        ConfigError: when a point has no inverse: the distortion folds back.
    """
    found = points
    for _ in range(iterations):
        error = points - distort(found, dist)
        if not np.abs(error).max(initial=0) >= EXACT:
            break
        found = np.clip(found + error, -FURTHEST, FURTHEST)
    lost = ~(np.abs(points - distort(found, dist)) < EXACT).all(axis=1)
    if lost.any():
        x, y = points[lost][0]
        raise ConfigError(
            f"synthetic data: lens {dist.tolist()} cannot be inverted within the image, it "
            f"folds back near x/z = {x:.2f}, y/z = {y:.2f}; give weaker coefficients"
        )
    return found
