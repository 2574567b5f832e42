"""TOML with one table per camera, as Pose2Sim and aniposelib write it."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import cv2

from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.utils.errors import DataError

NO_CAMERAS = ("metadata", "capture_volume", "charuco", "checkerboard")
KEYS = ("size", "matrix", "distortions", "rotation", "translation")


def read_toml(
    path: Path, scale: float | None, pixel_centre: float
) -> tuple[dict[str, CameraEntry], list[str]]:
    """Cameras by name: size [w, h], matrix, distortions, rotation (Rodrigues), translation.

    Convention: world to camera; metres as Pose2Sim writes them. aniposelib keeps the unit of its
    calibration board, often mm, without naming it: give it with ``unit``.

    Raises:
        DataError: when a table lacks a key, is a fisheye's, or holds something else.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError, RecursionError) as error:
        raise DataError(f"{path} is not readable as TOML: {error}") from None
    cameras: dict[str, CameraEntry] = {}
    for table, entry in content.items():
        if table in NO_CAMERAS or not isinstance(entry, dict):
            continue
        camera = _camera(path, table, entry, scale or 1.0, pixel_centre)
        if camera.name in cameras:
            raise DataError(f"{path} names two cameras {camera.name}; give each its own name")
        cameras[camera.name] = camera
    return cameras, []


def _camera(
    path: Path, table: str, entry: dict[str, Any], scale: float, pixel_centre: float
) -> CameraEntry:
    where = f"{path}, [{table}]"
    if missing := [key for key in KEYS if key not in entry]:
        raise DataError(f"{where} lacks '{missing[0]}'; expected {', '.join(KEYS)}")
    if entry.get("fisheye"):
        raise DataError(
            f"{where} is a fisheye camera, whose lens model is not supported; undistort its video "
            "and write a calibration without distortion"
        )
    width, height = numbers(where, entry["size"], "size", (2,))
    return make_camera(
        where,
        str(entry.get("name", table)),
        K=entry["matrix"],
        R=cv2.Rodrigues(numbers(where, entry["rotation"], "rotation", (3,)))[0],
        t=entry["translation"],
        dist=entry["distortions"],
        size=(int(height), int(width)),
        scale=scale,
        pixel_centre=pixel_centre,
    )
