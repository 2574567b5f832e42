"""TOML of Pose2Sim, aniposelib and caliscope, and Qualisys Track Manager's .qca.txt (XML)."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np

from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.data.files import natural_order
from gsgan.utils.arrays import as_floats
from gsgan.utils.errors import DataError

NO_CAMERAS = ("metadata", "capture_volume", "charuco", "checkerboard")
KEYS = ("size", "matrix", "distortions", "rotation", "translation")
SUBPIXELS = 64  # parts of a pixel in which focal lengths and centres are written
MILLIMETRE = 1e-3
VIDEO_MODELS = ("video", "hybrid", "none")  # the others see markers only
OPENCV_AXES = np.diag([1.0, -1.0, -1.0])  # Qualisys cameras look along -z, y up


def read_toml(
    path: Path, scale: float | None, pixel_centre: float
) -> tuple[dict[str, CameraEntry | None], list[str]]:
    """Cameras by name: size [w, h], matrix, distortions, rotation, translation.

    Convention: world to camera; the rotation is a Rodrigues vector, or a matrix; metres as Pose2Sim
    and caliscope write them. caliscope has one table per camera in another, [cameras.0]: the number
    is its name, and a camera that it ignores is None here. aniposelib keeps the unit of its
    calibration board, often mm, without naming it: give it with ``unit``.

    Raises:
        DataError: when a table lacks a key, is a fisheye's, or holds something else.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError, RecursionError) as error:
        raise DataError(f"{path} is not readable as TOML: {error}") from None
    cameras: dict[str, CameraEntry | None] = {}
    inner = content.get("cameras")
    for table, entry in (inner if isinstance(inner, dict) else content).items():
        if table in NO_CAMERAS or not isinstance(entry, dict):
            continue
        if entry.get("ignore"):
            cameras[table] = None
            continue
        camera = _toml_camera(path, table, entry, scale or 1.0, pixel_centre)
        if camera.name in cameras:
            raise DataError(f"{path} names two cameras {camera.name}; give each its own name")
        cameras[camera.name] = camera
    return cameras, []


def _toml_camera(
    path: Path, table: str, entry: dict[str, Any], scale: float, pixel_centre: float
) -> CameraEntry:
    where = f"{path}, [{table}]"
    if missing := [key for key in KEYS if key not in entry]:
        raise DataError(f"{where} lacks '{missing[0]}'; expected {', '.join(KEYS)}")
    if entry.get("fisheye"):
        raise DataError(
            f"{where} is a fisheye camera, which is not supported; undistort its video and "
            "calibrate it without distortion"
        )
    width, height = numbers(where, entry["size"], "size", (2,))
    R = entry["rotation"]
    if as_floats(R).shape != (3, 3):
        R = cv2.Rodrigues(numbers(where, R, "rotation", (3,)))[0]
    return make_camera(
        where,
        str(entry.get("name", table)),
        K=entry["matrix"],
        R=R,
        t=entry["translation"],
        dist=entry["distortions"],
        size=(int(height), int(width)),
        scale=scale,
        pixel_centre=pixel_centre,
    )


def read_qualisys(
    path: Path, scale: float | None, pixel_centre: float
) -> tuple[dict[str, CameraEntry], list[str]]:
    """Video cameras by serial, in natural order.

    Convention: positions in mm (or ``scale``); ``R = diag(1, -1, -1) r`` with r as the file's
    rows, ``t = -R C``; focal lengths and centre in 1/64 pixel, the centre counted from the
    sensor's corner, so the video window's left and top come off.

    Raises:
        DataError: when it is another kind of file, or a number is missing or impossible.
    """
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except (ElementTree.ParseError, OSError, ValueError, LookupError) as error:
        raise DataError(f"{path} is not readable as a Qualisys calibration: {error}") from None
    found, notes = {}, list[str]()
    for node in root.iter("camera"):
        serial = node.get("serial", "")
        model = node.get("model", "none").lower()
        if not any(word in model for word in VIDEO_MODELS):
            notes.append(f"{path}: camera {serial} ({model}) takes no video and is left out")
            continue
        if serial in found:
            raise DataError(f"{path} holds the camera {serial} twice; take one of them out")
        found[serial] = _qualisys_camera(path, serial, node, scale or MILLIMETRE, pixel_centre)
        if node.get("viewrotation", "0") != "0":
            notes.append(
                f"{path}: camera {serial} is turned by {node.get('viewrotation')} degrees; its "
                "video must be stored as the sensor saw it"
            )
    return {name: found[name] for name in sorted(found, key=natural_order)}, notes


def _qualisys_camera(
    path: Path, serial: str, node: ElementTree.Element, scale: float, pixel_centre: float
) -> CameraEntry:
    where = f"{path}, camera {serial}"
    parts = {child.tag: child.attrib for child in node}
    try:
        intrinsic, transform, window = (
            parts[tag] for tag in ("intrinsic", "transform", "fov_video")
        )
        f_u, f_v, c_u, c_v = (
            float(intrinsic[f"{kind}{axis}"]) / SUBPIXELS
            for kind in ("focalLength", "centerPoint")
            for axis in "UV"
        )
        skew = float(intrinsic.get("skew", 0)) / SUBPIXELS
        lens = [f"radialDistortion{i}" for i in (1, 2)]
        lens += [f"tangentalDistortion{i}" for i in (1, 2)] + ["radialDistortion3"]
        dist = [float(intrinsic[key]) for key in lens]
        r = np.array([[float(transform[f"r{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)])
        C = np.array([float(transform[axis]) for axis in "xyz"])
        left, top, right, bottom = (
            int(float(window[side])) for side in ("left", "top", "right", "bottom")
        )
    except (KeyError, ValueError, OverflowError) as error:
        raise DataError(f"{where}: a value is missing or unreadable ({error})") from None
    R = OPENCV_AXES @ r
    return make_camera(
        where,
        serial,
        K=[[f_u, skew, c_u - left], [0, f_v, c_v - top], [0, 0, 1]],
        R=R,
        t=-R @ C,
        dist=dist,
        size=(bottom - top + 1, right - left + 1),
        scale=scale,
        pixel_centre=pixel_centre,
    )
