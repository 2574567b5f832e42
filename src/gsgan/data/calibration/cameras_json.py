"""cameras.json, the bring-your-own layout's calibration, and meta.json's conventions for it.

``{camera: {K 3x3, R 3x3, t 3, dist 0/4/5/8, size [w, h]}}``
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsgan.data.cameras import EXPECTED, CameraEntry, make_camera, numbers
from gsgan.data.checks import Checks
from gsgan.data.files import read_json
from gsgan.utils.errors import DataError

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


@dataclass(frozen=True)
class Conventions:
    """How the numbers of a capture are stored.

    Args:
        scale: metres in one unit of the files.
        pixel_centre: 0.5, or 0 when K counts from the centre of the first pixel.
        composed: the images are already composed on black (``"background": "black"``).
    """

    scale: float = 1.0
    pixel_centre: float = 0.5
    composed: bool = False


def read_conventions(path: Path, content: Mapping[str, Any]) -> Conventions:
    """The conventions in the content of meta.json.

    Raises:
        DataError: on a missing unit or an unknown value.
    """
    return Conventions(
        scale=METRES[choose(path, content, "unit", None, tuple(METRES))],
        pixel_centre=choose(path, content, "pixel_centre", 0.5, (0, 0.5)),
        composed=choose(path, content, "background", "scene", ("scene", "black")) == "black",
    )


def choose(
    path: Path, content: Mapping[str, Any], key: str, default: Any, allowed: tuple[Any, ...]
) -> Any:
    """The value of a key, one of those allowed.

    Raises:
        DataError: when it is another.
    """
    value = content.get(key, default)
    if isinstance(value, (list, dict)) or value not in allowed:
        names = ", ".join(map(str, allowed))
        raise DataError(f"{path}: '{key}' is {value!r}; expected one of {names}")
    return value


def read_cameras_json(
    path: Path, scale: float | None, pixel_centre: float
) -> tuple[dict[str, CameraEntry], list[str]]:
    """Cameras by name; a meta.json beside the file gives its unit and pixel centre, else 0.5.

    Raises:
        DataError: naming the camera and the problem.
    """
    meta = path.with_name("meta.json")
    found = read_conventions(meta, read_json(meta)) if meta.is_file() else Conventions()
    if scale is not None:
        found = replace(found, scale=scale)
    return read_cameras(path, read_json(path), found, Checks()), []


def read_cameras(
    path: Path, content: Mapping[str, Any], conventions: Conventions, checks: Checks
) -> dict[str, CameraEntry]:
    """The cameras of cameras.json by name, in metres, pixel centres moved to +0.5.

    Raises:
        DataError: naming the camera and the problem.
    """
    if not content:
        raise DataError(f"{path} lists no camera")
    cameras = {}
    for name, entry in content.items():
        where = f"{path}, camera {name}"
        if not isinstance(entry, dict):
            raise DataError(f"{where}: expected an object with {EXPECTED}")
        for key in ("K", "R", "t", "size"):
            if key not in entry:
                raise DataError(f"{where}: '{key}' is missing; expected {EXPECTED}")
        size = numbers(where, entry["size"], "size", (2,))
        if np.any(size < 1) or np.any(size != np.round(size)):
            raise DataError(
                f"{where}: size must be [width, height] in pixels, found {entry['size']}"
            )
        cameras[name] = make_camera(
            where,
            name,
            K=entry["K"],
            R=entry["R"],
            t=entry["t"],
            dist=entry.get("dist"),
            size=(int(size[1]), int(size[0])),
            scale=conventions.scale,
            pixel_centre=conventions.pixel_centre,
            rotation_tolerance=checks.rotation_tolerance,
        )
    return cameras
