"""Cameras to render with: an orbit, a camera of the capture, or those of a calibration file."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsgan.data.calibration import read_calibration
from gsgan.data.cameras import CameraEntry
from gsgan.data.crop import PersonCrop, square_window
from gsgan.scene import Camera, cat
from gsgan.utils.errors import ConfigError, DataError

Float = NDArray[np.float64]


def of_entry(
    entry: CameraEntry, p: Float, size: int, crop: PersonCrop | None, lens: bool
) -> Camera:
    """A calibrated camera with square images, cropped to the whole motion if training cropped.

    Args:
        entry: the camera.
        p: ``[F, 33, 3]`` metres, world frame.
        size: pixels.
        crop: of the training images, or None.
        lens: keep its distortion, see `CameraEntry.seen`.
    """
    window = square_window(entry.size)
    if crop is not None:
        joints = p.reshape(-1, 3)
        known: NDArray[np.bool_] = np.asarray(np.isfinite(joints).all(-1))
        window = crop.window(entry, joints, known)
    return entry.seen(window, (size, size), lens=lens)


def from_file(path: Path, p: Float, size: int) -> Camera:
    """The camera of a calibration file, or its cameras, one per skeleton ``[F, 33, 3]``.

    Raises:
        DataError: when it cannot be read, or the number of cameras is neither 1 nor F.
    """
    found = list(read_calibration(path).cameras.values())
    if len(found) not in (1, len(p)):
        raise DataError(
            f"{path} holds {len(found)} cameras; expected 1, or {len(p)}, one per frame"
        )
    if any(0 in entry.size for entry in found):
        raise DataError(f"{path} lacks an image size; every camera needs one")
    return cat([of_entry(entry, p, size, None, lens=True) for entry in found])


def of_capture(entries: Mapping[str, CameraEntry], name: str) -> CameraEntry:
    """A camera of the run's data by name.

    Raises:
        ConfigError: listing the names, when there is no such camera.
    """
    if name not in entries:
        raise ConfigError(
            f"camera={name} is neither a camera of the run's data nor a file; choose orbit or one "
            f"of {', '.join(entries)}"
        )
    return entries[name]
