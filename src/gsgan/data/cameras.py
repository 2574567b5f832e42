"""One calibrated camera, checked and converted from raw calibration values."""

import reprlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from gsgan.scene import Camera
from gsgan.utils.arrays import Float, as_floats
from gsgan.utils.errors import DataError

# Numbers of coefficients that OpenCV's lens model can have.
DISTORTION_LENGTHS = (4, 5, 8)
FISHEYE_LENGTHS = (4,)  # of OpenCV's model of fisheye lenses
# maximum entry of R Rᵀ - I
ROTATION_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Crop:
    """A rectangle of whole pixels; it may reach beyond the image.

    Args:
        top: row of its first pixel.
        left: column of its first pixel.
        size: ``(H, W)`` pixels.
    """

    top: int
    left: int
    size: tuple[int, int]


@dataclass(frozen=True)
class CameraEntry:
    """One calibrated camera, float64 numpy.

    Args:
        name: as in the calibration.
        K: ``[3, 3]`` pixels, pixel centres at +0.5.
        R: ``[3, 3]`` world to camera.
        t: ``[3]`` metres.
        dist: ``[8]`` OpenCV order, zero-padded; of a fisheye lens k1 k2 k3 k4.
        size: ``(H, W)``.
        fisheye: the lens is that of OpenCV's fisheye module, which bends even without coefficients.
    """

    name: str
    K: Float
    R: Float
    t: Float
    dist: Float
    size: tuple[int, int]
    fisheye: bool = False

    @property
    def centre(self) -> Float:
        """``[3]`` metres: the position of the camera."""
        # x_cam = R x + t is 0 at the centre.
        return -self.R.T @ self.t

    @property
    def distorted(self) -> bool:
        """Whether the lens bends straight lines."""
        return self.fisheye or bool(np.any(self.dist != 0))

    @property
    def keeps_lens(self) -> bool:
        """Whether `Camera` can hold its distortion: five coefficients at most."""
        few = not self.fisheye and not self.dist[5:].any()
        return self.distorted and few

    def view_of(
        self, window: Crop, size: tuple[int, int] | None, *, lens: bool
    ) -> Camera:
        """The camera of a window of the image.

        Args:
            window: may reach beyond the image.
            size: ``(H, W)`` that the window is scaled to; None leaves it as it is.
            lens: keep the distortion if `keeps_lens`; otherwise the camera is a pinhole.
        """
        # The rasteriser knows five coefficients.
        dist = None
        if lens and self.keeps_lens:
            dist = torch.from_numpy(self.dist[None, :5])
        camera = Camera(
            K=torch.from_numpy(self.K)[None],
            R=torch.from_numpy(self.R)[None],
            t=torch.from_numpy(self.t)[None],
            size=self.size,
            dist=dist,
        )

        # Still in float64, so that K is rounded once.
        camera = camera.crop(window.top, window.left, window.size)
        if size is not None:
            camera = camera.resize(size)
        return camera.to(torch.float32)


def make_camera(
    where: str,
    name: str,
    *,
    K: Any,
    R: Any,
    t: Any,
    dist: Any,
    size: tuple[int, int],
    scale: float = 1.0,
    pixel_centre: float = 0.5,
    fisheye: bool = False,
) -> CameraEntry:
    """A camera from raw calibration values (lists, columns, arrays), checked and converted.

    Args:
        where: file and camera, for messages.
        name: of the camera.
        K: ``[3, 3]``.
        R: ``[3, 3]`` world to OpenCV camera axes.
        t: 3 numbers in the file's unit.
        dist: 0, 4, 5 or 8 numbers, or None; of a fisheye lens 4.
        size: ``(H, W)`` pixels.
        scale: metres in one unit of the file.
        pixel_centre: the centre of the first pixel in the file's K, 0 or 0.5.
        fisheye: the lens is that of OpenCV's fisheye module.

    Raises:
        DataError: naming the camera and the problem.
    """
    # K is upper triangular, with the principal point moved to pixel centres at +0.5.
    K = numbers(where, K, "K", (3, 3))
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise DataError(
            f"{where}: the focal lengths in K must be above 0, found {K[0, 0]:g} and {K[1, 1]:g}"
        )
    if K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
        raise DataError(
            f"{where}: K must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], found {K.tolist()}"
        )
    K[:2, 2] += 0.5 - pixel_centre

    # R is orthonormal and does not mirror.
    R = numbers(where, R, "R", (3, 3))
    error = np.abs(R @ R.T - np.eye(3)).max()
    if error > ROTATION_TOLERANCE:
        raise DataError(
            f"{where}: R is not a rotation, R Rᵀ differs from the identity by {error:.3g} "
            f"(allowed {ROTATION_TOLERANCE:g})"
        )
    if np.linalg.det(R) < 0:
        raise DataError(
            f"{where}: R mirrors; expected a rotation, world to OpenCV camera axes"
        )

    # All lengths are in metres from here on.
    metres = numbers(where, t, "t", (3,)) * scale
    lens = _lens(
        where, dist, FISHEYE_LENGTHS if fisheye else DISTORTION_LENGTHS
    )
    return CameraEntry(name, K, R, metres, lens, size, fisheye)


def numbers(
    where: str,
    raw: Any,
    key: str,
    shape: tuple[int, ...],
) -> Float:
    """Finite float64 numbers of a shape, also where they are a flat list, a column or a row.

    Raises:
        DataError: when they are something else.
    """
    array = as_floats(raw)
    # A translation is often written as a column, a matrix as nine numbers row by row.
    if array.size == int(np.prod(shape)) and array.ndim != len(shape):
        array = array.reshape(shape)
    if array.shape != shape or not np.isfinite(array).all():
        raise DataError(
            f"{where}: '{key}' must hold finite numbers of shape {shape}, found {_short(raw)}"
        )
    return array


# deeply or endlessly nested values are not printed in full
SHORT = reprlib.Repr()
SHORT.maxlevel = 4
SHORT.maxlist = 16
SHORT.maxtuple = 16
SHORT.maxother = 400


def _short(raw: Any, limit: int = 120) -> str:
    """A value on one line, cut off after ``limit`` characters, for messages."""
    # Line breaks become blanks.
    text = " ".join(SHORT.repr(raw).split())
    return text if len(text) <= limit else text[:limit] + "…"


def _lens(where: str, raw: Any, lengths: tuple[int, ...]) -> Float:
    """``[8]`` OpenCV lens coefficients, zero-padded; None and an empty list mean none."""
    # Absent coefficients are 0.
    padded = np.zeros(8)
    if raw is None or (isinstance(raw, (list, tuple)) and not raw):
        return padded
    dist = as_floats(raw).reshape(-1)
    if len(dist) not in lengths or not np.isfinite(dist).all():
        counts = " or ".join(map(str, lengths))
        order = (
            "k1 k2 k3 k4"
            if lengths == FISHEYE_LENGTHS
            else "k1 k2 p1 p2 k3 ..."
        )
        raise DataError(
            f"{where}: dist must hold {counts} finite numbers ({order}), found {_short(raw)}"
        )
    # The order k1 k2 p1 p2 k3 k4 k5 k6 is the same for every length.
    padded[: len(dist)] = dist
    return padded
