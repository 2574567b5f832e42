"""Where to look in a picture, and how the looked-at part is cut out.

A window is found from the skeleton and the camera alone, never from the picture or its mask: at
test time nothing else is known, and a box that follows the true mask would tell the answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.utils.errors import ConfigError

Float = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Pixels = NDArray[np.float32]

NEAR = 1e-2  # metres; nothing nearer is seen


class View(Protocol):
    """What a window needs to know of a camera: ``K R t`` as in `gsgan.scene`, size ``(H, W)``."""

    @property
    def K(self) -> Float: ...
    @property
    def R(self) -> Float: ...
    @property
    def t(self) -> Float: ...
    @property
    def size(self) -> tuple[int, int]: ...


@dataclass(frozen=True)
class Window:
    """A rectangle of whole pixels; it may reach beyond the picture.

    Args:
        top: row of its first pixel.
        left: column of its first pixel.
        size: ``(H, W)`` pixels.
    """

    top: int
    left: int
    size: tuple[int, int]


def project(view: View, points: Float) -> tuple[Float, Float]:
    """Pixels ``[..., 2]`` (centres at +0.5) and depths ``[...]`` of world points ``[..., 3]``.

    Lens distortion is not applied. Points nearer than `NEAR` get finite, meaningless pixels: mask
    them by depth.
    """
    x_cam = points @ view.R.T + view.t
    depth = x_cam[..., 2]
    uvw = (x_cam / np.maximum(depth, NEAR)[..., None]) @ view.K.T
    return uvw[..., :2], depth


def inside(view: View, points: Float) -> NDArray[np.bool_]:
    """``[...]`` whether world points ``[..., 3]`` land in the picture; False for NaN."""
    pixels, depth = project(view, points)
    height, width = view.size
    u, v = pixels[..., 0], pixels[..., 1]
    return (depth > NEAR) & (u >= 0) & (u < width) & (v >= 0) & (v < height)


@dataclass(frozen=True)
class PersonCrop:
    """A square window round the projected joints.

    Args:
        margin: metres of flesh, hair and cloth taken round every joint; landmarks lie inside the
            body, and the crown is about 0.2 m above the ears.

    Raises:
        ConfigError: when the margin is not positive.
    """

    margin: float = 0.2

    def __post_init__(self) -> None:
        if not self.margin > 0:
            raise ConfigError(f"data.crop.margin must be above 0 metres, got {self.margin}")

    def window(
        self, view: View, joints: Float, usable: NDArray[np.bool_], dist: Float | None = None
    ) -> Window:
        """The window round the usable joints, cut to the picture, then made square.

        A joint far outside the picture shows nothing, so the box does not follow it; the square
        may still reach beyond the border.

        Args:
            view: the camera.
            joints: ``[J, 3]`` metres, world frame, finite.
            usable: ``[J]`` which of them to go by; joints behind the camera are left out as well.
            dist: ``[8]`` the lens, where the picture keeps its distortion; None: a pinhole's.
        """
        height, width = view.size
        pixels, depth = project(view, joints)
        if dist is not None:
            pixels = _through_lens(view.K, dist, pixels)
        taken = usable & (depth > NEAR)
        if not taken.any():
            return square_window(view.size)
        focal = max(view.K[0, 0], view.K[1, 1])
        reach = (self.margin * focal / depth[taken])[:, None]
        limit = np.array([width, height], np.float64)
        low = np.clip((pixels[taken] - reach).min(0), 0, limit)
        high = np.clip((pixels[taken] + reach).max(0), 0, limit)
        side = max(1, int(np.ceil((high - low).max())))
        left, top = np.floor((low + high - side) / 2).astype(int)
        return Window(int(top), int(left), (side, side))


def square_window(size: tuple[int, int]) -> Window:
    """The smallest centred square that holds a whole picture of size ``(H, W)``."""
    side = max(size)
    return Window((size[0] - side) // 2, (size[1] - side) // 2, (side, side))


def cut(picture: Bytes, window: Window) -> Bytes:
    """``[h, w, ...]`` the window of a picture ``[H, W, ...]``, zero beyond the border."""
    height, width = picture.shape[:2]
    h, w = window.size
    result = np.zeros((h, w, *picture.shape[2:]), picture.dtype)
    top, left = max(window.top, 0), max(window.left, 0)
    bottom, right = min(window.top + h, height), min(window.left + w, width)
    if bottom > top and right > left:
        rows = slice(top - window.top, bottom - window.top)
        columns = slice(left - window.left, right - window.left)
        result[rows, columns] = picture[top:bottom, left:right]
    return result


def undistort_map(K: Float, dist: Float, window: Window) -> NDArray[np.float32]:
    """``[h, w, 2]`` where each pixel of an undistorted window lies in the distorted picture.

    Coordinates are what `cv2.remap` takes (pixel centres at whole numbers). K is kept, skew
    included, which `cv2.undistort` would drop. Beyond the radius where the lens model folds back
    on itself the map points outside the picture.

    Args:
        K: ``[3, 3]``, pixel centres at +0.5.
        dist: ``[8]`` OpenCV order k1 k2 p1 p2 k3 k4 k5 k6.
        window: of the undistorted picture.
    """
    if K[0, 1] == 0:  # OpenCV's own is ten times as fast, but knows no skew
        u, v = _opencv_map(K, dist, window)
    else:
        u, v = _skewed_map(K, dist, window)
    limit = fold_radius(K, dist, window)
    if limit is not None:
        x, y = _rays(K, window)
        beyond = x * x + y * y > limit**2
        u[beyond], v[beyond] = -1e4, -1e4
    return np.stack([u, v], axis=-1)


def _opencv_map(K: Float, dist: Float, window: Window) -> tuple[Pixels, Pixels]:
    h, w = window.size
    stored = K.copy()
    stored[:2, 2] -= 0.5  # to OpenCV's pixel centres
    seen = stored.copy()
    seen[:2, 2] -= (window.left, window.top)
    u, v = cv2.initUndistortRectifyMap(stored, dist, np.eye(3), seen, (w, h), cv2.CV_32FC1)
    return np.asarray(u, np.float32), np.asarray(v, np.float32)


def _skewed_map(K: Float, dist: Float, window: Window) -> tuple[Pixels, Pixels]:
    x_d, y_d = _bent(dist, *_rays(K, window))
    u = K[0, 0] * x_d + K[0, 1] * y_d + K[0, 2] - 0.5
    v = K[1, 1] * y_d + K[1, 2] - 0.5
    return u.astype(np.float32), v.astype(np.float32)


def _bent(dist: Float, x: Float, y: Float) -> tuple[Float, Float]:
    """Where the lens shows x/z and y/z."""
    p1, p2 = dist[2:4]
    r2 = x * x + y * y
    factor = _radial(dist, r2)
    x_d = x * factor + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    y_d = y * factor + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return x_d, y_d


def _through_lens(K: Float, dist: Float, pixels: Float) -> Float:
    """``[M, 2]`` where the lens shows what a pinhole shows at pixels ``[M, 2]``."""
    y = (pixels[:, 1] - K[1, 2]) / K[1, 1]
    x = (pixels[:, 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    x, y = _bent(dist, x, y)
    return np.stack([K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]], axis=-1)


def _rays(K: Float, window: Window) -> tuple[Float, Float]:
    """``[h, w]`` each: x/z and y/z of the window's pixels."""
    h, w = window.size
    v, u = np.mgrid[window.top : window.top + h, window.left : window.left + w] + 0.5
    y = (v - K[1, 2]) / K[1, 1]
    return (u - K[0, 2] - K[0, 1] * y) / K[0, 0], y


def _radial(dist: Float, r2: Float) -> Float:
    k1, k2, _, _, k3, k4, k5, k6 = dist
    up = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return up / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))


def fold_radius(K: Float, dist: Float, window: Window, samples: int = 256) -> float | None:
    """The radius (of x/z, y/z) beyond which the lens model folds back, None within the window.

    Args:
        samples: radii looked at, from the middle to the window's furthest corner.
    """
    h, w = window.size
    corners = np.array([(i, j) for i in (0.5, h - 0.5) for j in (0.5, w - 0.5)])
    y = (window.top + corners[:, 0] - K[1, 2]) / K[1, 1]
    x = (window.left + corners[:, 1] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    radii = np.linspace(0, np.sqrt((x * x + y * y).max()), samples)
    folded = np.flatnonzero(np.diff(radii * _radial(dist, radii**2)) <= 0)
    return float(radii[folded[0]]) if len(folded) else None


def take(picture: Bytes, window: Window, mapping: NDArray[np.float32] | None, exact: bool) -> Bytes:
    """The window of a picture, undistorted where a mapping is given, zero beyond the border.

    Args:
        picture: ``[H, W]`` or ``[H, W, C]``.
        window: what to take.
        mapping: of `undistort_map` for the same window, or None for a pinhole camera.
        exact: keep values as they are (labels) instead of mixing neighbours.
    """
    if mapping is None:
        return cut(picture, window)
    mode = cv2.INTER_NEAREST if exact else cv2.INTER_LINEAR
    maps = (mapping[..., 0], mapping[..., 1])
    taken = cv2.remap(
        picture, *maps, interpolation=mode, borderMode=cv2.BORDER_CONSTANT, borderValue=0
    )
    return np.asarray(taken, np.uint8)


def resize(picture: Bytes, size: tuple[int, int], exact: bool) -> Bytes:
    """A picture resampled to ``(H, W)``; edges stay edges, so K scales with the size alone.

    Shrinking averages areas, enlarging interpolates linearly, ``exact`` takes the nearest value.
    """
    if picture.shape[:2] == size:
        return picture
    if exact:
        mode = cv2.INTER_NEAREST_EXACT
    elif size[0] < picture.shape[0]:
        mode = cv2.INTER_AREA
    else:
        mode = cv2.INTER_LINEAR
    return np.asarray(cv2.resize(picture, size[::-1], interpolation=mode), np.uint8)


def black_out(image: Bytes, mask: Bytes, composed: bool) -> Bytes:
    """An image ``[H, W, 3]`` on black by its mask ``[H, W]``.

    Args:
        image: as taken, or already composed on black.
        mask: 0..255.
        composed: the image was mixed with black by this mask when it was made; mixing it again
            would darken soft edges twice, so only pixels outside the mask are cleared.
    """
    if composed:
        return image * (mask > 0)[..., None]
    return np.asarray(cv2.multiply(image, cv2.merge([mask] * 3), scale=1 / 255), np.uint8)
