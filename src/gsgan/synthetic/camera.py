"""Cameras of the synthetic scene and the rays of their pixels.

Units are metres in the world frame; cameras and lenses are OpenCV's, pixel centres are at +0.5.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsgan.data.crop import distort, undistort
from gsgan.motion.rotations import unit
from gsgan.utils.errors import ConfigError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

CAMERA_DISTANCE = 2.8  # metres from the middle of the scene to the cameras
# Share of the image kept free at each edge, over all frames and cameras.
IMAGE_MARGIN = 0.02
# The fractional part of the golden ratio.
GOLDEN_RATIO = (5**0.5 - 1) / 2


@dataclass(frozen=True)
class SceneCamera:
    """A camera: ``K [3, 3]``, ``R [3, 3]``, ``t [3]``, ``size`` (H, W), lens ``dist`` or None."""

    K: Array  # [3, 3] pixels
    R: Array  # [3, 3] world to camera
    t: Array  # [3] metres
    size: tuple[int, int]  # height and width, pixels
    dist: Array | None = None  # [4, 5 or 8] OpenCV's coefficients

    @property
    def centre(self) -> Array:
        return -self.R.T @ self.t

    def project(self, points: Array) -> Array:
        """``[N, 2]`` pixels of world points ``[N, 3]``, all in front of the camera."""
        x = points @ self.R.T + self.t
        # The lens acts before the intrinsics.
        if self.dist is not None:
            shown = distort(x[:, :2] / x[:, 2:], self.dist)
            return shown @ self.K[:2, :2].T + self.K[:2, 2]
        x = x @ self.K.T
        return x[:, :2] / x[:, 2:]

    def bend(self, directions: Array) -> Array:
        """The unit world rays ``[N, 3]`` seen where a pinhole sees the unit ``directions``."""
        if self.dist is None:
            return directions

        # From the pixels that a pinhole has to what the lens shows there.
        rays = directions @ self.R.T
        straight = undistort(rays[:, :2] / rays[:, 2:], self.dist)
        bent = np.concatenate([straight, np.ones((len(rays), 1))], axis=1)
        return unit(bent @ self.R)


def pixel_offsets(rays: int) -> Array:
    """``[rays, 2]`` positions in a pixel, in [0, 1): the golden-ratio lattice about its centre.

    At edges of any direction its error is half that of random or R2 points.
    """
    k = np.arange(rays) - (rays - 1) / 2
    lattice = np.stack([k / rays, k * GOLDEN_RATIO], axis=1)
    return np.mod(0.5 + lattice, 1.0)


def pixel_rays(
    view: SceneCamera, x: Ints, y: Ints, rays: int
) -> tuple[Array, Array]:
    """Origin ``[3]`` and unit directions ``[N*rays, 3]`` of a pinhole's pixels ``x, y [N]``."""
    # Positions of the rays in the image, and their directions in the world.
    offset = pixel_offsets(rays)
    across = (x[:, None] + offset[:, 0]).ravel()
    down = (y[:, None] + offset[:, 1]).ravel()
    pixel = np.stack([across, down, np.ones_like(across)], axis=1)
    directions = pixel @ (np.linalg.inv(view.K).T @ view.R)
    return view.centre, unit(directions)


def look_at(
    azimuth: float, height: float, middle: Array, points: Array, size: int
) -> SceneCamera:
    """A camera at an azimuth: 0 in front of the person, growing towards the person's left."""
    # The camera's axes, in world coordinates.
    direction = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    centre = (
        np.array([middle[0], middle[1], height]) + direction * CAMERA_DISTANCE
    )
    forward = middle - centre
    forward /= np.linalg.norm(forward)

    # Its axes: right, down and forwards, which make no roll.
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    t = -R @ centre

    # The focal length and principal point that keep the points within the margins.
    x = points @ R.T + t
    rays = x[:, :2] / x[:, 2:]
    low = rays.min(axis=0)
    high = rays.max(axis=0)
    focal = (1 - 2 * IMAGE_MARGIN) * size / (high - low).max()
    cx, cy = size / 2 - focal * (low + high) / 2
    K = np.array(
        [
            [focal, 0, cx],
            [0, focal, cy],
            [0, 0, 1],
        ]
    )
    return SceneCamera(K=K, R=R, t=t, size=(size, size))


def zoom(view: SceneCamera, scale: float) -> SceneCamera:
    """A camera whose focal length is ``scale`` times larger, zoomed about the image's centre."""
    H, W = view.size
    centre = [W / 2, H / 2]
    K = view.K.copy()
    K[:2, :2] *= scale
    K[:2, 2] = scale * (K[:2, 2] - centre) + centre
    return replace(view, K=K)


def through_lens(view: SceneCamera, dist: Array) -> SceneCamera:
    """A camera with a lens.

    Raises:
        ConfigError: when the distortion folds back within the image.
    """
    # The corners of the image and the middles of its edges.
    H, W = view.size
    x, y = np.meshgrid([0, W / 2, W], [0, H / 2, H], indexing="ij")
    pixels = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    points = (pixels @ np.linalg.inv(view.K).T)[:, :2]

    lost = np.isnan(undistort(points, dist)).any(axis=1)
    if lost.any():
        x, y = points[lost][0]
        raise ConfigError(
            f"synthetic data: lens {dist.tolist()} folds back near x/z = {x:.2f}, y/z = {y:.2f}, "
            "within the image; give weaker coefficients"
        )
    return replace(view, dist=dist)
