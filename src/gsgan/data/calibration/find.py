"""Finds a calibration file and reads it, by its content; cameras.json and meta.json's conventions.

cameras.json is the bring-your-own layout's calibration:
``{camera: {K 3x3, R 3x3, t 3, dist 0/4/5/8, size [w, h]}}``
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsgan.data.calibration.opencv_yaml import read_opencv_yaml
from gsgan.data.calibration.text import read_qualisys, read_toml
from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.data.files import read_json
from gsgan.data.validation import Thresholds
from gsgan.utils.errors import DataError

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
EXPECTED = "K, R, t, dist and size"
HEAD = 65536  # bytes that are enough to recognise the format
PATTERNS = ("cameras.json", "intri.yml", "intri.yaml", "*.qca.txt", "*.qca", "*.toml")
KNOWN = (
    "OpenCV YAML (intri.yml beside extri.yml), TOML of Pose2Sim, aniposelib or caliscope, Qualisys "
    ".qca.txt, or cameras.json"
)


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


@dataclass(frozen=True)
class Calibration:
    """The cameras of a calibration file.

    Args:
        path: the file.
        format: its name in words.
        cameras: by name, metres, K with pixel centres at +0.5; a size of (0, 0) is unknown.
        notes: one sentence for each omission or oddity.
        ignored: names of cameras that the file says to ignore.
    """

    path: Path
    format: str
    cameras: dict[str, CameraEntry]
    notes: tuple[str, ...] = ()
    ignored: tuple[str, ...] = ()


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
    return read_cameras(path, read_json(path), found, Thresholds()), []


def read_cameras(
    path: Path, content: Mapping[str, Any], conventions: Conventions, checks: Thresholds
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
        keys = ("K", "R", "t", "size")
        if not isinstance(entry, dict) or any(key not in entry for key in keys):
            raise DataError(f"{where}: expected an object with {EXPECTED}")
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
            rotation_tolerance=checks.rotation_tolerance,
        )
    return cameras


Cameras = Mapping[str, CameraEntry | None]  # by name; None is one that the file says to ignore
Reader = Callable[[Path, float | None, float], tuple[Cameras, list[str]]]
"""Cameras and notes by path, metres in a unit (None: the format's own), and K's pixel centre."""
FORMATS: dict[str, tuple[Callable[[str], bool], Reader]] = {
    "OpenCV YAML": (lambda head: head.lstrip().startswith("%YAML"), read_opencv_yaml),
    "Qualisys": (lambda head: "<calibration" in head and "<camera" in head, read_qualisys),
    "cameras.json": (lambda head: head.lstrip().startswith("{"), read_cameras_json),
    "TOML": (lambda head: "[" in head and "matrix" in head, read_toml),
}


def read_calibration(
    path: Path, unit_scale: float | None = None, pixel_centre: float = 0.0
) -> Calibration:
    """The cameras of a calibration file, whichever of the known formats it is.

    Args:
        path: the file; for OpenCV YAML either of the two.
        unit_scale: metres in one unit of its lengths, None for the format's own (Qualisys mm,
            else m; meta.json gives it for cameras.json).
        pixel_centre: where K puts the first pixel's centre, 0 or 0.5; not read for cameras.json.

    Raises:
        DataError: when it is none of the formats, or a value is impossible.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(HEAD).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise DataError(
            f"{path} cannot be read ({error.strerror or error}); give the calibration file"
        ) from None
    for name, (fits, reader) in FORMATS.items():
        if fits(head):
            found, notes = reader(path, unit_scale, pixel_centre)
            cameras = {key: camera for key, camera in found.items() if camera is not None}
            if not cameras:
                raise DataError(f"{path} ({name}) lists no camera that can be used")
            ignored = tuple(key for key in found if key not in cameras)
            return Calibration(path, name, cameras, tuple(notes), ignored)
    raise DataError(f"{path} is not a known calibration; expected {KNOWN}")


def find_calibration(folder: Path) -> Path:
    """The only calibration file in a capture folder, or in its subfolders named like calibration.

    Raises:
        DataError: when there is none, or more than one.
    """
    places = [folder, *(p for p in folder.glob("*") if p.is_dir() and "calib" in p.name.lower())]
    found = sorted({p for place in places for pattern in PATTERNS for p in place.glob(pattern)})
    # other .toml files are configs
    found = [p for p in found if p.suffix != ".toml" or b"matrix" in p.read_bytes()]
    if not found:
        raise DataError(f"{folder} holds no calibration; give calibration=<file>: {KNOWN}")
    if len(found) > 1:
        names = ", ".join(str(p.relative_to(folder)) for p in found)
        raise DataError(
            f"{folder} holds more than one calibration ({names}); give calibration=<file>"
        )
    return found[0]
