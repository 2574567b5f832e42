"""Crops of images around the person, undistorted and resampled.

A crop follows from the skeleton and the camera alone, never from the image or its mask: at test
time nothing else is known, and a box that follows the true mask would leak the answer.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gsgan.data.cameras import CameraEntry, Crop
from gsgan.scene import NEAR
from gsgan.utils.arrays import Bytes, Float
from gsgan.utils.checks import positive

# of x/z: maximum error of an undistorted point
FOUND = 1e-8
# OpenCV's default of 5 iterations is pixels off in the corners of a strong lens.
CONVERGED = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 400, 1e-12)
# Only OpenCV 5 takes the criteria without "Iter".
_undistort = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)


def project(view: CameraEntry, points: Float) -> tuple[Float, Float]:
    """Pixels ``[..., 2]`` (centres at +0.5) and depths ``[...]`` of world points ``[..., 3]``.

    The projection is ``K (R x + t)``, without lens distortion. Points nearer than `NEAR` get
    finite, meaningless pixels: mask them by depth.
    """
    # x_cam = R x + t, then the pinhole.
    x_cam = np.tensordot(points, view.R.T, 1) + view.t
    depth = x_cam[..., 2]  # [...]
    rays = x_cam / np.maximum(depth, NEAR)[..., None]
    uvw = np.tensordot(rays, view.K.T, 1)
    return uvw[..., :2], depth


def inside(view: CameraEntry, points: Float) -> NDArray[np.bool_]:
    """``[...]`` whether world points ``[..., 3]`` project into the image; False for NaN."""
    # Not divided by the depth, which would be slow: u < width becomes u * depth < width * depth.
    height, width = view.size
    uvw = np.tensordot(points, (view.K @ view.R).T, 1) + view.K @ view.t
    u = uvw[..., 0]
    v = uvw[..., 1]
    depth = uvw[..., 2]
    across = (u >= 0) & (u < width * depth)
    along = (v >= 0) & (v < height * depth)
    return (depth > NEAR) & across & along


@dataclass(frozen=True)
class PersonCrop:
    """A square crop around the projected joints.

    Args:
        margin: metres kept around every joint for flesh, hair and cloth, above 0: landmarks lie
            inside the body, and the crown is about 0.2 m above the ears.
    """

    margin: float = 0.2

    def __post_init__(self) -> None:
        positive("data.crop.margin", self.margin)

    def window(
        self,
        view: CameraEntry,
        joints: Float,
        usable: NDArray[np.bool_],
        *,
        lens: bool = False,
    ) -> Crop:
        """The crop around the usable joints, clipped to the image, then made square.

        Joints outside the image do not widen it; the square may still reach beyond the border.

        Args:
            view: the camera.
            joints: ``[J, 3]`` metres, world frame, finite.
            usable: ``[J]`` which of them count; joints behind the camera never do.
            lens: whether the image keeps its distortion.
        """
        # Joints in the image, as this image shows them.
        pixels, depth = project(view, joints)
        if lens:
            pixels = through_lens(view, pixels[:, 0], pixels[:, 1])
        taken = usable & (depth > NEAR)
        if not taken.any():
            return square_window(view.size)

        # The margin in pixels at each joint's depth.
        focal = max(view.K[0, 0], view.K[1, 1])
        reach = (self.margin * focal / depth[taken])[:, None]  # [n, 1]

        # The box around all joints and their margins, clipped to the image.
        limit = np.array(view.size[::-1], np.float64)
        low = np.clip((pixels[taken] - reach).min(0), 0, limit)
        high = np.clip((pixels[taken] + reach).max(0), 0, limit)

        # A square of whole pixels with the same centre.
        side = max(1, int(np.ceil((high - low).max())))
        left, top = np.floor((low + high - side) / 2).astype(int)
        return Crop(int(top), int(left), (side, side))


def square_window(size: tuple[int, int]) -> Crop:
    """The smallest centred square that holds a whole image of size ``(H, W)``."""
    # Half of the missing pixels on each side.
    height, width = size
    side = max(size)
    return Crop((height - side) // 2, (width - side) // 2, (side, side))


def cut(image: Bytes, crop: Crop) -> Bytes:
    """``[h, w, ...]`` the crop of an image ``[H, W, ...]``, zero beyond the border."""
    # Everything beyond the border stays 0.
    height, width = image.shape[:2]
    h, w = crop.size
    result = np.zeros((h, w, *image.shape[2:]), image.dtype)

    # The part of the crop that lies in the image, in the image's pixels.
    top = max(crop.top, 0)
    left = max(crop.left, 0)
    bottom = min(crop.top + h, height)
    right = min(crop.left + w, width)

    # The same part in the crop's pixels.
    if bottom > top and right > left:
        rows = slice(top - crop.top, bottom - crop.top)
        columns = slice(left - crop.left, right - crop.left)
        result[rows, columns] = image[top:bottom, left:right]
    return result


def undistort_map(
    camera: CameraEntry,
    crop: Crop,
) -> NDArray[np.float32]:
    """``[h, w, 2]`` where each pixel of an undistorted crop lies in the distorted image.

    Coordinates as `cv2.remap` takes them (pixel centres at whole numbers). K is kept, skew
    included, which `cv2.undistort` would drop. Beyond the radius where the lens model folds back
    the map points outside the image.

    Args:
        camera: with K of pixel centres at +0.5.
        crop: of the undistorted image.
    """
    K = camera.K
    u, v = _grid(crop)
    if K[0, 1] == 0 and not camera.fisheye:
        # OpenCV's own function is ten times as fast, but ignores skew.
        stored = K.copy()
        stored[:2, 2] -= 0.5  # to OpenCV's pixel centres

        # The window's corner becomes the origin.
        seen = stored.copy()
        seen[:2, 2] -= (crop.left, crop.top)
        size = crop.size[::-1]
        eye = np.eye(3)
        maps = cv2.initUndistortRectifyMap(
            stored, camera.dist, eye, seen, size, cv2.CV_32FC1
        )
        pixels = np.stack(maps, axis=-1)
    else:
        pixels = (through_lens(camera, u, v) - 0.5).astype(np.float32)

    # Beyond the fold the lens model shows points twice: those pixels stay empty.
    limit = fold_radius(camera, crop)
    if limit is not None:
        x, y = _unproject(K, u, v)
        pixels[x * x + y * y > limit**2] = -1e4
    return np.asarray(pixels, np.float32)


def distort(points: Float, dist: Float, fisheye: bool = False) -> Float:
    """``[..., 2]`` where a lens shows points ``[..., 2]`` of the z = 1 plane, by OpenCV.

    Args:
        points: x/z and y/z.
        dist: ``[4, 5 or 8]`` OpenCV order k1 k2 p1 p2 k3 k4 k5 k6; of a fisheye k1 k2 k3 k4.
        fisheye: the lens is that of OpenCV's fisheye module.
    """
    if points.size == 0:
        return points
    flat = points.reshape(-1, 2)
    if fisheye:
        shown = cv2.fisheye.distortPoints(flat[:, None], np.eye(3), dist[:4])
        return np.asarray(shown, np.float64).reshape(points.shape)
    rays = np.concatenate([flat, np.ones((len(flat), 1))], axis=-1)

    # A camera at the origin with K = I: its pixels are x/z and y/z.
    nothing = np.zeros(3)
    shown = cv2.projectPoints(rays, nothing, nothing, np.eye(3), dist)[0]
    return np.asarray(shown, np.float64).reshape(points.shape)


def undistort(points: Float, dist: Float, fisheye: bool = False) -> Float:
    """``[N, 2]`` the inverse of `distort`, accurate to `FOUND`; NaN beyond the fold, and where a
    fisheye lens looks sideways or back."""
    if points.size == 0:
        return points
    eye = np.eye(3)

    # Iterative, since the lens models have no inverse in closed form.
    if fisheye:
        raw = cv2.fisheye.undistortPoints(
            points[:, None], eye, dist[:4], criteria=CONVERGED
        )
    else:
        raw = _undistort(
            points[:, None],
            eye,
            dist,
            R=eye,
            P=eye,
            criteria=CONVERGED,
        )
    rays = raw[:, 0].astype(np.float64)

    # The iteration may end at a wrong point, so its result is distorted again and compared.
    again = distort(rays, dist, fisheye)
    error = np.abs(again - points).max(axis=1, keepdims=True)
    return np.asarray(np.where(error < FOUND, rays, np.nan))


def through_lens(camera: CameraEntry, u: Float, v: Float) -> Float:
    """``[..., 2]`` pixels where the lens shows what a pinhole shows at pixels u, v ``[...]``."""
    K = camera.K
    x, y = _unproject(K, u, v)
    shown = distort(np.stack([x, y], axis=-1), camera.dist, camera.fisheye)
    return shown @ K[:2, :2].T + K[:2, 2]


def _unproject(
    K: Float,
    u: Float,
    v: Float,
) -> tuple[Float, Float]:
    """x/z and y/z of pixels: the inverse of ``u = fx x + s y + cx``, ``v = fy y + cy``."""
    y = (v - K[1, 2]) / K[1, 1]
    x = (u - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return x, y


def _grid(crop: Crop) -> tuple[Float, Float]:
    """``[h, w]`` each: u and v of the crop's pixels, centres at +0.5."""
    h, w = crop.size
    v, u = np.mgrid[crop.top : crop.top + h, crop.left : crop.left + w] + 0.5
    return u, v


def fold_radius(
    camera: CameraEntry,
    crop: Crop,
    samples: int = 256,
) -> float | None:
    """The radius (of x/z, y/z) beyond which the lens model folds back, None within the crop.

    Args:
        samples: radii tested, from the centre to the crop's furthest corner.
    """
    # Radii from the centre to the crop's furthest corner.
    h, w = crop.size
    left = crop.left + 0.5
    right = crop.left + w - 0.5
    top = crop.top + 0.5
    bottom = crop.top + h - 0.5
    u = np.array([left, left, right, right])
    v = np.array([top, bottom, top, bottom])
    x, y = _unproject(camera.K, u, v)
    radii = np.linspace(0, np.hypot(x, y).max(), samples)  # [samples]

    # The lens model folds back where the distorted radius no longer grows.
    # without p1 and p2, which a fisheye lens does not have
    radial = camera.dist.copy()
    if not camera.fisheye:
        radial[2:4] = 0
    along_x = np.stack([radii, np.zeros(samples)], axis=-1)

    # Along one axis: without tangential terms all directions are alike.
    shown = distort(along_x, radial, camera.fisheye)[:, 0]  # [samples]
    folded = np.flatnonzero(np.diff(shown) <= 0)
    return float(radii[folded[0]]) if len(folded) else None


def take(
    image: Bytes,
    crop: Crop,
    mapping: NDArray[np.float32] | None,
    exact: bool,
) -> Bytes:
    """A crop of an image, undistorted if a mapping is given, zero beyond the border.

    Args:
        image: ``[H, W]`` or ``[H, W, C]``.
        mapping: `undistort_map` of the same crop, or None for a pinhole camera.
        exact: take the nearest value (labels) instead of interpolating.
    """
    if mapping is None:
        return cut(image, crop)

    # Labels must not be mixed.
    mode = cv2.INTER_NEAREST if exact else cv2.INTER_LINEAR
    # Pixels outside the image are 0: the default border.
    taken = cv2.remap(
        image,
        mapping[..., 0],
        mapping[..., 1],
        mode,
        borderMode=cv2.BORDER_CONSTANT,
    )
    return np.asarray(taken, np.uint8)


def resize(
    image: Bytes,
    size: tuple[int, int],
    exact: bool,
) -> Bytes:
    """An image resampled to ``(H, W)``; its borders stay, so K scales with the size alone.

    Shrinking averages areas, enlarging interpolates linearly, ``exact`` takes the nearest value.
    """
    if image.shape[:2] == size:
        return image
    if exact:
        # A mean of labels would be another label.
        mode = cv2.INTER_NEAREST_EXACT
    elif size[0] < image.shape[0]:
        mode = cv2.INTER_AREA
    else:
        mode = cv2.INTER_LINEAR
    return np.asarray(
        cv2.resize(image, size[::-1], interpolation=mode), np.uint8
    )


def black_out(
    image: Bytes,
    mask: Bytes,
    composed: bool,
) -> Bytes:
    """An image ``[H, W, 3]`` on black by its mask ``[H, W]``.

    Args:
        image: as taken, or already composed on black.
        mask: 0..255.
        composed: the image was blended with black by this mask before; blending again would
            darken soft edges twice, so only pixels outside the mask are cleared.
    """
    if composed:
        return image * (mask > 0)[..., None]

    # OpenCV rounds image * alpha / 255 to the nearest value.
    alpha = cv2.merge([mask, mask, mask])
    return np.asarray(cv2.multiply(image, alpha, scale=1 / 255), np.uint8)
