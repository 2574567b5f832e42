"""Calibration files, recognised by their content: cameras.json, OpenCV YAML, TOML, nerfstudio,
Qualisys, and by their name: COLMAP.

cameras.json is the bring-your-own layout's calibration:
``{camera: {K 3x3, R 3x3, t 3, dist 0/4/5/8, size [w, h], fisheye false}}``
"""

import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import yaml

from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.data.reconstructions import (
    OPENGL,
    is_colmap,
    is_nerfstudio,
    read_colmap,
    read_nerfstudio,
)
from gsgan.utils.arrays import Float, as_floats
from gsgan.utils.errors import DataError
from gsgan.utils.files import is_json_object, read_json, read_text

# Metres in one unit.
METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
# Bytes at the start of a file that are enough to recognise its format.
HEAD_BYTES = 65536
# The maximum size of a YAML file, in bytes: enough for some 1000 cameras.
MAX_YAML_BYTES = 2**20
# names of calibration files
PATTERNS = (
    "cameras.json",
    "intri.yml",
    "intri.yaml",
    "*.toml",
    "transforms.json",
    "cameras.txt",
    "cameras.bin",
    "*.qca.txt",
)
# folders of a project that hold calibrations, beside those named like calibration
PLACES = ("sparse", "sparse/0", "colmap/sparse/0")
KNOWN = (
    "OpenCV YAML (intri.yml beside extri.yml), TOML of Pose2Sim, aniposelib or caliscope, COLMAP's "
    "cameras and images (.txt or .bin), nerfstudio's transforms.json, Qualisys' .qca.txt, JSON of "
    "CMU Panoptic or THuman4.0, or cameras.json"
)
# formats whose worlds have no scale and any orientation
WITHOUT_SCALE = ("COLMAP", "nerfstudio")
# Qualisys counts in parts of a pixel, of a sensor with this many rows that are stored.
SUBPIXELS = 64
QUALISYS_ROWS = 1080
# radians, about two turns: a longer rotation vector is in degrees
MAX_TURN = 12.0
# names of the lens in other programs' files
LENS_NAMES = (
    "distortion",
    "distortions",
    "dist_coeffs",
    "distCoeffs",
    "distCoef",
    "D",
)
# of a camera in the JSON of Panoptic, THuman4.0 and AvatarReX
DATASET_KEYS = {
    "K": ("K",),
    "R": ("R",),
    "t": ("t", "T"),
    "size": ("resolution", "imgSize"),
    "dist": ("distCoef", "distCoeff"),
}
# of a camera's table in TOML
TOML_KEYS = ("size", "matrix", "distortions", "rotation", "translation")
# tables that are no cameras
TOML_OTHER_TABLES = ("metadata", "capture_volume", "charuco", "checkerboard")


@dataclass(frozen=True)
class Conventions:
    """Conventions by which the numbers of a capture are stored.

    Args:
        scale: metres in one unit of the files.
        pixel_centre: 0.5, or 0 when K counts from the centre of the first pixel.
        composed: the images are already composed on black (``"background": "black"``).
    """

    scale: float = 1.0
    pixel_centre: float = 0.5
    composed: bool = False


@dataclass(frozen=True)
class Calibration:
    """The cameras of a calibration file.

    Args:
        path: the file.
        format: its name in words.
        cameras: by name, metres, K with pixel centres at +0.5; a size of (0, 0) is unknown.
        notes: one sentence for each omission or oddity.
        metric: whether lengths are in metres; otherwise their unit is unknown, and the world has
            any orientation.
    """

    path: Path
    format: str
    cameras: dict[str, CameraEntry]
    notes: tuple[str, ...] = ()
    metric: bool = True


def find_calibration(folder: Path) -> Path:
    """The only calibration file in a capture folder, or in its subfolders named like calibration.

    Raises:
        DataError: when there is none, or more than one.
    """
    # The folder itself, and subfolders such as "calibration", "calib_test" and "sparse/0".
    places = [folder, *(folder / place for place in PLACES)]
    for path in folder.glob("*"):
        if path.is_dir() and "calib" in path.name.lower():
            places.append(path)

    # Files by name, each once although patterns overlap.
    files = set[Path]()
    for place in places:
        for pattern in PATTERNS:
            files.update(place.glob(pattern))

    # Other .toml files are configs.
    paths = []
    for path in sorted(files):
        if path.suffix != ".toml" or b"matrix" in path.read_bytes():
            paths.append(path)

    # Exactly one must be left.
    if not paths:
        raise DataError(
            f"{folder} holds no calibration; give calibration=<file>: {KNOWN}"
        )
    if len(paths) > 1:
        names = ", ".join(str(path.relative_to(folder)) for path in paths)
        raise DataError(
            f"{folder} holds more than one calibration ({names}); give calibration=<file>"
        )
    return paths[0]


def read_calibration(
    path: Path, unit_scale: float | None = None, pixel_centre: float = 0.0
) -> Calibration:
    """Reads the cameras of a calibration file in any of the known formats.

    Args:
        path: the file; for OpenCV YAML and COLMAP either of the two.
        unit_scale: metres in one unit of its lengths; None for the format's own (metres, or the
            unit in meta.json next to cameras.json).
        pixel_centre: where K puts the first pixel's centre, 0 or 0.5; not read for cameras.json,
            COLMAP and nerfstudio.

    Raises:
        DataError: when it is none of the formats, or a value is impossible.
    """
    # The start of the file tells its format, whatever its name is.
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD_BYTES).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise DataError(
            f"{path} cannot be read ({error.strerror or error}); give the calibration file"
        ) from None

    # The first format whose test the head passes.
    for name, (fits, reader) in FORMATS.items():
        if fits(path, head):
            notes: list[str] = []
            cameras = reader(path, unit_scale, pixel_centre, notes)
            if not cameras:
                raise DataError(
                    f"{path} ({name}) lists no camera that can be used"
                )

            # COLMAP and nerfstudio have no unit: the person's height gives it
            # later.
            metric = unit_scale is not None or name not in WITHOUT_SCALE
            return Calibration(path, name, cameras, tuple(notes), metric)
    raise DataError(f"{path} is not a known calibration; expected {KNOWN}")


# -- cameras.json and meta.json


def read_conventions(path: Path, content: Mapping[str, Any]) -> Conventions:
    """The conventions in the content of meta.json.

    Raises:
        DataError: on a missing unit or an unknown value.
    """
    # Only the unit has no default.
    unit = choose(path, content, "unit", None, tuple(METRES))
    background = choose(
        path, content, "background", "scene", ("scene", "black")
    )
    return Conventions(
        scale=METRES[unit],
        pixel_centre=choose(path, content, "pixel_centre", 0.5, (0, 0.5)),
        composed=background == "black",
    )


def choose(
    path: Path,
    content: Mapping[str, Any],
    key: str,
    default: Any,
    allowed: tuple[Any, ...],
) -> Any:
    """The value of a key, which must be one of those allowed.

    Raises:
        DataError: when it is not.
    """
    value = content.get(key, default)
    # Lists and objects are refused first: they cannot be compared with every allowed value.
    if isinstance(value, (list, dict)) or value not in allowed:
        names = ", ".join(map(str, allowed))
        raise DataError(
            f"{path}: '{key}' is {value!r}; expected one of {names}"
        )
    return value


def read_cameras(
    path: Path, content: Mapping[str, Any], conventions: Conventions
) -> dict[str, CameraEntry]:
    """The cameras of cameras.json by name, in metres, pixel centres moved to +0.5.

    Raises:
        DataError: naming the camera and the problem.
    """
    # Files of other programs may have the same name.
    if not content:
        raise DataError(f"{path} lists no camera")
    if isinstance(content.get("frames"), list):  # a camera would be an object
        raise DataError(
            f"{path} is a scene of nerfstudio; gsgan.prepare calibration={path} reads it"
        )

    cameras = {}
    for name, entry in content.items():
        where = f"{path}, camera {name}"
        # The lens may be missing: then it is a pinhole.
        if not isinstance(entry, dict) or not {"K", "R", "t", "size"} <= set(
            entry
        ):
            there = (
                ", ".join(list(entry)[:8]) if isinstance(entry, dict) else ""
            )
            raise DataError(
                f"{where}: expected an object with K, R, t, dist and size, found "
                f"{there or type(entry).__name__}"
            )

        # A lens by another name would be ignored.
        unknown = sorted(set(entry) & set(LENS_NAMES))
        if unknown:
            raise DataError(
                f"{where}: the lens is named {unknown[0]!r}; expected 'dist', OpenCV's "
                "coefficients [k1, k2, p1, p2, k3]"
            )

        # Stored as [width, height], while sizes are (H, W) everywhere else.
        width, height = numbers(where, entry["size"], "size", (2,))
        if width < 1 or height < 1 or width % 1 or height % 1:
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
            size=(int(height), int(width)),
            scale=conventions.scale,
            pixel_centre=conventions.pixel_centre,
            fisheye=bool(entry.get("fisheye")),
        )
    return cameras


def _read_json(
    path: Path,
    scale: float | None,
    pixel_centre: float,
    notes: list[str],
) -> dict[str, CameraEntry]:
    """The cameras of cameras.json; a meta.json next to it gives unit and pixel centre."""
    # Without meta.json, the defaults of the bring-your-own layout.
    meta = path.with_name("meta.json")
    conventions = Conventions()
    if meta.is_file():
        conventions = read_conventions(meta, read_json(meta))

    # A unit that the user gives comes first.
    if scale:
        conventions = replace(conventions, scale=scale)
    return read_cameras(path, read_json(path), conventions)


def _read_dataset_json(
    path: Path, scale: float | None, pixel_centre: float, notes: list[str]
) -> dict[str, CameraEntry]:
    """The cameras of CMU Panoptic's JSON, in cm, or of THuman4.0's and AvatarReX's, in metres."""
    content = read_json(path)
    listed = content.get("cameras")
    entries = list(content.items())
    if isinstance(listed, list):
        scale = scale or METRES["cm"]
        entries = []
        for number, entry in enumerate(listed):
            name = entry.get("name") if isinstance(entry, dict) else None
            if name is None or name in dict(entries):
                raise DataError(
                    f"{path}, camera {number} of the list: expected an object with a name of its "
                    f"own, found {name}"
                )
            entries.append((str(name), entry))
    cameras = {}
    for name, entry in entries:
        where = f"{path}, camera {name}"
        if not isinstance(entry, dict):
            raise DataError(f"{where}: expected an object with K, R and T")

        # The keys of either dataset.
        given = {}
        for key, names in DATASET_KEYS.items():
            there = [name for name in names if name in entry]
            if not there and key != "dist":
                raise DataError(f"{where}: {' or '.join(names)} is missing")
            given[key] = entry[there[0]] if there else None
        width, height = numbers(where, given["size"], "size", (2,))
        cameras[name] = make_camera(
            where,
            name,
            K=given["K"],
            R=given["R"],
            t=given["t"],
            dist=given["dist"],
            size=(int(height), int(width)),
            scale=scale or 1.0,
            pixel_centre=pixel_centre,
        )
    return cameras


# -- TOML of Pose2Sim, aniposelib and caliscope


def _read_toml(
    path: Path,
    scale: float | None,
    pixel_centre: float,
    notes: list[str],
) -> dict[str, CameraEntry]:
    """Cameras by name: size [w, h], matrix, distortions, rotation, translation.

    R and t map world to camera; the rotation is a Rodrigues vector or a matrix; lengths are in
    metres, as Pose2Sim and caliscope write them. caliscope has one table per camera inside another,
    [cameras.0]: the number is its name; a camera that it ignores is left out. aniposelib keeps the
    unit of its calibration board, often mm, without naming it: give it with ``unit``.
    """
    # A damaged file can fail in any of these ways.
    try:
        content = tomllib.loads(read_text(path))
    except (
        tomllib.TOMLDecodeError,
        UnicodeDecodeError,
        OSError,
        RecursionError,
    ) as error:
        raise DataError(f"{path} is not readable as TOML: {error}") from None

    # The cameras of caliscope are tables inside another one.
    inner = content.get("cameras")
    tables = inner if isinstance(inner, dict) else content

    cameras: dict[str, CameraEntry] = {}
    for table, entry in tables.items():
        # Tables about the file or the board, single values, and cameras that are ignored.
        if table in TOML_OTHER_TABLES or not isinstance(entry, dict):
            continue
        if entry.get("ignore"):
            continue

        # A camera's name is the table's, unless the table has one.
        name = str(entry.get("name", table))
        if name in cameras:
            raise DataError(
                f"{path} names two cameras {name}; give each its own name"
            )
        where = f"{path}, [{table}]"
        cameras[name] = _toml_camera(
            where, name, entry, scale or 1.0, pixel_centre
        )
    return cameras


def _toml_camera(
    where: str,
    name: str,
    entry: dict[str, Any],
    scale: float,
    pixel_centre: float,
) -> CameraEntry:
    # All keys are needed; a missing one is most likely misspelt.
    for key in TOML_KEYS:
        if key not in entry:
            raise DataError(
                f"{where} lacks '{key}'; expected {', '.join(TOML_KEYS)}"
            )

    width, height = numbers(where, entry["size"], "size", (2,))

    # A rotation that is no matrix is a Rodrigues vector.
    R = entry["rotation"]
    if as_floats(R).size != 9:
        R = _rotation_matrix(where, R, "rotation")
    return make_camera(
        where,
        name,
        K=entry["matrix"],
        R=R,
        t=entry["translation"],
        dist=entry["distortions"],
        size=(int(height), int(width)),
        scale=scale,
        pixel_centre=pixel_centre,
        fisheye=bool(entry.get("fisheye")),
    )


# -- OpenCV YAML in two files, as EasyMocap writes it


class _Loader(yaml.BaseLoader):
    """YAML of text and matrices; nothing in a file is run."""


def _matrix(loader: _Loader, node: yaml.MappingNode) -> Float:
    """``[rows, cols]`` of an ``!!opencv-matrix``."""
    # rows, cols and the values row by row; their type does not matter.
    parts = loader.construct_mapping(node, deep=True)
    values = np.array(list(map(float, parts["data"])), np.float64)
    return values.reshape(int(parts["rows"]), int(parts["cols"]))


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _matrix)


def read_opencv_yaml(path: Path) -> dict[str, Any]:
    """The top level of a FileStorage file: text, lists of text, and matrices ``[rows, cols]``.

    PyYAML reads it: damaged files can make OpenCV's own reader corrupt memory.

    Raises:
        DataError: when it is too large, not such a file, or damaged.
    """
    # Every error ends in the same message, with its reason.
    reason = "no keys"
    try:
        if path.stat().st_size > MAX_YAML_BYTES:
            raise ValueError(f"more than {MAX_YAML_BYTES} bytes")
        # The first line is %YAML:1.0, where YAML itself has a blank; its line number must stay.
        text = re.sub(r"\A(\s*)%YAML.*", r"\1", read_text(path))

        # Names of entries are text; a file of other content has none.
        values = yaml.load(text, _Loader)
        if isinstance(values, dict) and all(
            isinstance(key, str) for key in values
        ):
            return values
    except (
        OSError,
        yaml.YAMLError,
        ArithmeticError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        reason = " ".join(str(error).split())[:120]
    raise DataError(
        f"{path} is not readable as OpenCV YAML ({reason}); it may be cut off: export it again"
    )


def _read_yaml(
    path: Path,
    scale: float | None,
    pixel_centre: float,
    notes: list[str],
) -> dict[str, CameraEntry]:
    """Cameras by name: K, dist (or D), H, W from intri; Rot or R (Rodrigues), T from extri.

    Lengths are in metres; R and t map world to camera. The two files list names in different orders
    and with "none" entries, so cameras are paired by name alone. Without H and W the size is
    (0, 0).
    """
    # The paths of both files, whichever of them was given.
    intri_path = path.with_name(re.sub("intri|extri", "intri", path.name))
    extri_path = path.with_name(re.sub("intri|extri", "extri", path.name))
    if intri_path == extri_path:
        raise DataError(
            f"{path}: expected OpenCV YAML named intri.yml beside extri.yml"
        )

    # One alone is of no use.
    for file in (intri_path, extri_path):
        if not file.is_file():
            raise DataError(
                f"{file} does not exist; intri.yml and extri.yml belong together"
            )
    intri = read_opencv_yaml(intri_path)
    extri = read_opencv_yaml(extri_path)

    # Each name once; without a list of names, those of the matrices K.
    names = intri.get("names")
    if not isinstance(names, list):
        names = [key[2:] for key in intri if key.startswith("K_")]
    cameras = {}
    for name in dict.fromkeys(map(str, names)):
        if name == "none":
            continue
        where = f"{intri_path}, camera {name}"

        # Each camera needs K, R and T, from the two files.
        if f"K_{name}" not in intri:
            raise DataError(f"{where} lacks K_{name}; export it again")

        R = _opencv_rotation(where, name, extri)
        if R is None or f"T_{name}" not in extri:
            raise DataError(
                f"{extri_path} lacks Rot_{name} (or R_{name}) and T_{name}, but {intri_path} lists "
                f"the camera {name}; calibrate it, or take it out of both"
            )

        # Missing coefficients may be an oversight, so a note mentions them.
        dist = intri.get(f"dist_{name}", intri.get(f"D_{name}"))
        if dist is None:
            notes.append(
                f"{intri_path} gives no lens distortion for {name}: taken as none"
            )

        # A file without the size leaves it at (0, 0), for the reader to set from the images.
        height = int(numbers(where, intri.get(f"H_{name}", 0), "H", ()))
        width = int(numbers(where, intri.get(f"W_{name}", 0), "W", ()))
        cameras[name] = make_camera(
            where,
            name,
            K=intri[f"K_{name}"],
            R=R,
            t=extri[f"T_{name}"],
            dist=dist,
            size=(max(0, height), max(0, width)),
            scale=scale or 1.0,
            pixel_centre=pixel_centre,
        )
    return cameras


def _opencv_rotation(where: str, name: str, extri: Mapping[str, Any]) -> Any:
    """A camera's rotation: the matrix Rot, else from the Rodrigues vector R, else None."""
    # Files have the matrix, the vector, or both.
    R = extri.get(f"Rot_{name}")
    if R is None and f"R_{name}" in extri:
        R = _rotation_matrix(where, extri[f"R_{name}"], f"R_{name}")
    return R


def _rotation_matrix(where: str, value: Any, what: str) -> Any:
    """The matrix ``[3, 3]`` of a Rodrigues vector, whose length is an angle in radians."""
    vector = numbers(where, value, what, (3,))
    angle = float(np.linalg.norm(vector))
    if angle > MAX_TURN:
        raise DataError(
            f"{where}: {what} turns by {angle:.0f}; expected a rotation vector in radians"
        )
    return cv2.Rodrigues(vector)[0]


# -- Qualisys


def _read_qualisys(
    path: Path,
    scale: float | None,
    pixel_centre: float,
    notes: list[str],
) -> dict[str, CameraEntry]:
    """The cameras of Qualisys' XML by serial number; lengths are in mm.

    Cameras that are turned off or not calibrated are left out. Without a window of the video the
    size is (0, 0).
    """
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise DataError(f"{path} is not readable as XML: {error}") from None

    cameras: dict[str, CameraEntry] = {}
    for element in root.iter("camera"):
        if element.get("active") == "0" or element.get("calibrated") == "false":
            continue
        name = element.get("serial")
        if name is None or name in cameras:
            raise DataError(
                f"{path} has a camera without a 'serial' of its own, {name}"
            )
        where = f"{path}, camera {name}"
        cameras[name] = _qualisys_camera(
            where, name, element, scale or METRES["mm"], pixel_centre
        )
    return cameras


def _qualisys_camera(
    where: str,
    name: str,
    camera: ElementTree.Element,
    scale: float,
    pixel_centre: float,
) -> CameraEntry:
    def values(element: str, *keys: str) -> Float:
        node = camera.find(element)
        if node is None:
            raise DataError(f"{where} lacks <{element}>; export it again")
        raw = [node.get(key) for key in keys]
        return numbers(where, raw, f"{element} {' '.join(keys)}", (len(keys),))

    # Axes are rows; y points up and z backward.
    rows = (f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))
    R = OPENGL @ values("transform", *rows).reshape(3, 3)
    t = -R @ values("transform", "x", "y", "z")

    # The window of the sensor that the video shows, in pixels of all rows.
    left, top, height, width = 0.0, 0.0, 0.0, 0.0
    if camera.find("fov_video") is not None:
        left, top, right, bottom = values(
            "fov_video", "left", "top", "right", "bottom"
        )
        height, width = bottom - top + 1, right - left + 1

    # A video of fewer rows, such as 540p, is a smaller image of the same window.
    stored = re.match(r"(\d+)p$", camera.get("video_resolution", ""))
    zoom = int(stored[1]) / QUALISYS_ROWS if stored else 1.0

    # Focal lengths and principal point are in parts of a pixel, the lens is OpenCV's.
    parts = values(
        "intrinsic",
        "focalLengthU",
        "focalLengthV",
        "centerPointU",
        "centerPointV",
    )
    fx, fy, cx, cy = zoom * parts / SUBPIXELS
    cx -= zoom * (left + pixel_centre - 0.5)
    cy -= zoom * (top + pixel_centre - 0.5)
    lens = values(
        "intrinsic",
        "radialDistortion1",
        "radialDistortion2",
        "tangentalDistortion1",
        "tangentalDistortion2",
        "radialDistortion3",
    )
    return make_camera(
        where,
        name,
        K=[[fx, 0, cx], [0, fy, cy], [0, 0, 1]],
        R=R,
        t=t,
        dist=lens,
        size=(round(height * zoom), round(width * zoom)),
        scale=scale,
    )


# -- all formats


def _read_colmap(
    path: Path, scale: float | None, pixel_centre: float, notes: list[str]
) -> dict[str, CameraEntry]:
    return read_colmap(path, scale or 1.0)


def _read_nerfstudio(
    path: Path, scale: float | None, pixel_centre: float, notes: list[str]
) -> dict[str, CameraEntry]:
    return read_nerfstudio(path, scale or 1.0)


Reader = Callable[
    [Path, float | None, float, list[str]], dict[str, CameraEntry]
]
"""Cameras of a path, metres in a unit (None: the format's own), K's pixel centre; gains notes."""
# The test of a path and a file's head, and the reader of each format; the first that fits is taken.
FORMATS: dict[str, tuple[Callable[[Path, str], bool], Reader]] = {
    "COLMAP": (lambda path, _: is_colmap(path), _read_colmap),
    "OpenCV YAML": (
        lambda _, head: (
            head.lstrip().startswith(("%YAML", "---"))
            or "!!opencv-matrix" in head
        ),
        _read_yaml,
    ),
    "Qualisys": (
        lambda _, head: "<calibration" in head and "<camera" in head,
        _read_qualisys,
    ),
    "nerfstudio": (lambda _, head: is_nerfstudio(head), _read_nerfstudio),
    "JSON of Panoptic or THuman4.0": (
        lambda _, head: (
            is_json_object(head)
            and ('"imgSize"' in head or '"resolution"' in head)
        ),
        _read_dataset_json,
    ),
    "cameras.json": (lambda _, head: is_json_object(head), _read_json),
    "TOML": (lambda _, head: "[" in head and "matrix" in head, _read_toml),
}
