"""cameras.json, the bring-your-own layout's calibration."""

from __future__ import annotations

from pathlib import Path

from gsgan.data.cameras import CameraEntry
from gsgan.data.checks import Checks
from gsgan.data.files import read_json
from gsgan.data.formats.capture import read_cameras
from gsgan.data.formats.capture_meta import Conventions, read_meta


def read_own_json(
    path: Path, scale: float | None, pixel_centre: float
) -> tuple[dict[str, CameraEntry], list[str]]:
    """Cameras by name; a meta.json beside the file says its unit and pixel centre, else 0.5.

    Raises:
        DataError: on what cannot be a camera.
    """
    meta = path.with_name("meta.json")
    conventions = Conventions(scale=1.0, pixel_centre=0.5, composed=False)
    if meta.is_file():
        conventions = read_meta(meta)[1]
    if scale is not None:
        conventions = Conventions(scale, conventions.pixel_centre, composed=False)
    return read_cameras(path, read_json(path), conventions, Checks()), []
