"""Finds the calibration file in a capture folder, and its format."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from gsgan.data.calibration.cameras_json import read_cameras_json
from gsgan.data.calibration.opencv_yaml import read_opencv_yaml
from gsgan.data.calibration.qualisys import read_qualisys
from gsgan.data.calibration.toml_tables import read_toml
from gsgan.data.cameras import CameraEntry
from gsgan.utils.errors import DataError

HEAD = 65536  # bytes that are enough to recognise the format
PATTERNS = ("cameras.json", "intri.yml", "intri.yaml", "*.qca.txt", "*.qca", "*.toml")
KNOWN = (
    "OpenCV YAML (intri.yml beside extri.yml), TOML of Pose2Sim or aniposelib, Qualisys .qca.txt, "
    "or cameras.json"
)


@dataclass(frozen=True)
class Calibration:
    """The cameras of a calibration file.

    Args:
        path: the file.
        format: its name in words.
        cameras: by name, metres, K with pixel centres at +0.5; a size of (0, 0) is unknown.
        notes: one sentence for each omission or oddity.
    """

    path: Path
    format: str
    cameras: dict[str, CameraEntry]
    notes: tuple[str, ...] = ()


class Reader(Protocol):
    """Reads one format: path, metres in a unit (None: the format's own), K's pixel centre."""

    def __call__(
        self, path: Path, scale: float | None, pixel_centre: float
    ) -> tuple[dict[str, CameraEntry], list[str]]: ...


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
            cameras, notes = reader(path, unit_scale, pixel_centre)
            if not cameras:
                raise DataError(f"{path} ({name}) lists no camera that can be used")
            return Calibration(path, name, cameras, tuple(notes))
    raise DataError(f"{path} is not a known calibration; expected {KNOWN}")


def find_calibration(folder: Path) -> Path:
    """The only calibration file in a capture folder, or in its subfolders named like calibration.

    Raises:
        DataError: when there is none, or more than one.
    """
    places = [
        folder,
        *sorted(p for p in folder.glob("*") if p.is_dir() and "calib" in p.name.lower()),
    ]
    found = sorted({p for place in places for pattern in PATTERNS for p in place.glob(pattern)})
    found = [p for p in found if p.suffix != ".toml" or "matrix" in _text(p)]  # not a config file
    if not found:
        raise DataError(f"{folder} holds no calibration; give calibration=<file>: {KNOWN}")
    if len(found) > 1:
        names = ", ".join(str(p.relative_to(folder)) for p in found)
        raise DataError(
            f"{folder} holds more than one calibration ({names}); give calibration=<file>"
        )
    return found[0]


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
