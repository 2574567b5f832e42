"""3D joints of markerless motion capture: .trc files (Pose2Sim) and .c3d files."""

import re
import warnings
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsgan.data.skeletons import whole_frame_ids
from gsgan.motion.clip import rate_of
from gsgan.skeleton.joints import BODY, is_known, zeros_as_missing
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.errors import ConfigError, DataError, GsganError
from gsgan.utils.files import read_text, with_decimal_points
from gsgan.utils.frame_files import frame_files

Float = NDArray[np.float64]
Ints = NDArray[np.int64]
# Metres in a unit that a file may name, and other names of units, in lower case.
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
UNIT_NAMES = {
    "meters": "m",
    "metres": "m",
    "centimeters": "cm",
    "millimeters": "mm",
    "millimetres": "mm",
}
LEFT_RIGHT_SHOULDER = [11, 12]
LEFT_RIGHT_HIP = [23, 24]
TRUNK_LENGTH = 0.5  # metres from shoulder to hip
TRC_HEADER = 5  # lines before the first frame; markers are named in the fourth
TRC_AXES = [
    2,
    0,
    1,
]  # Pose2Sim writes (y, z, x) so that y is up: columns of x, y, z


class Points3D(NamedTuple):
    """3D joints of F numbered frames."""

    frames: Ints  # [F] increasing
    p: Float  # [F, 33, 3] metres, in the calibration's world; NaN = missing
    conf: Float  # [F, 33] 0 = missing
    fps: float | None  # frames per second, if the file has them


class Markers(NamedTuple):
    """The content of a file: M named markers in F frames, in the order of the file."""

    frames: Ints  # [F]
    names: list[str]
    places: Float  # [F, M, 3] in the file's unit; NaN = missing
    unit: str | None
    fps: float | None


def json_files(path: Path) -> dict[int, Path]:
    """A folder's JSON files by frame number, in increasing order."""
    files = frame_files(path.parent, path.name, (".json",))
    if not files:
        raise DataError(
            f"{path} holds no JSON files; expected one per frame, numbered"
        )
    return {number: path.parent / files[number] for number in sorted(files)}


def read_points3d(path: Path) -> Points3D:
    """3D joints of a .trc or .c3d file; exact zeros are missing.

    Raises:
        DataError: when it is damaged, or without shoulders and hips.
        ConfigError: for a .c3d file without the extra ``c3d``.
    """
    points = (
        _read_c3d(path) if path.suffix.lower() == ".c3d" else _read_trc(path)
    )
    unit = points.unit
    if unit is not None:
        unit = UNIT_NAMES.get(unit.lower(), unit.lower())
    if unit is not None and unit not in UNITS:
        raise DataError(
            f"{path}: Units is {points.unit!r}; expected one of {', '.join(UNITS)}"
        )

    # The joints that MediaPipe has too.
    p = np.full((len(points.places), BODY, 3), np.nan)
    for marker, name in enumerate(points.names):
        joint = _joint(name)
        if joint is not None:
            p[:, joint] = points.places[:, marker]

    # Some programs write zeros for markers that were not seen.
    p = zeros_as_missing(p)
    pairs = (LEFT_RIGHT_SHOULDER, LEFT_RIGHT_HIP)
    if not all(np.isfinite(p[:, pair]).any() for pair in pairs):
        raise DataError(
            f"{path} has no shoulders and hips; expected joints such as LShoulder and LHip, found "
            f"{', '.join(points.names)}"
        )
    p *= _metres(p) if unit is None else UNITS[unit]
    order = np.argsort(points.frames)
    p = p[order]

    # A joint without all coordinates is missing.
    seen = is_known(p)
    return Points3D(
        frames=points.frames[order],
        p=np.where(seen[..., None], p, np.nan),
        conf=seen.astype(np.float64),
        fps=points.fps,
    )


def _read_trc(path: Path) -> Markers:
    try:
        text = with_decimal_points(read_text(path, errors="replace"))
        lines = text.splitlines()
        header = dict(zip(lines[1].split(), lines[2].split(), strict=False))
        if "\t" not in lines[3]:
            raise ValueError("its columns are not separated by tabs")
        markers = [name for name in lines[3].split("\t")[2:] if name]

        # Frame, time and the coordinates.
        columns = 2 + 3 * len(markers)
        rows = []
        for line in lines[TRC_HEADER:]:
            if line.strip():
                rows.append(_numbers(line, columns))
    except (OSError, ValueError, IndexError) as error:
        raise DataError(
            f"{path} cannot be read as a .trc file ({error})"
        ) from None

    # The header's columns are shifted if it has a number there: Units is then left out.
    unit = header.get("Units")
    if unit is not None and re.fullmatch(r"[\d.]+", unit):
        unit = None
    fps = None
    with suppress(KeyError, ValueError):
        fps = rate_of(path, float(header["DataRate"]))

    # Frame number and time come first, then three columns per marker.
    table = np.array(rows).reshape(-1, columns)
    places = table[:, 2:].reshape(len(table), len(markers), 3)
    return Markers(
        frames=whole_frame_ids(table[:, 0], str(path)),
        names=markers,
        places=places[..., TRC_AXES],
        unit=unit,
        fps=fps,
    )


def _read_c3d(path: Path) -> Markers:
    try:
        import c3d
    except ImportError:
        raise ConfigError(
            f"{path}: .c3d files need the package c3d: pip install 'gsgan[c3d]'"
        ) from None
    try:
        # The package warns of missing analog channels and incomplete blocks.
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            reader = c3d.Reader(file)
            names = [label.strip() for label in reader.point_labels]
            unit = reader.get("POINT:UNITS")
            read = [(n, points) for n, points, _ in reader.read_frames()]
            fps = rate_of(path, float(reader.point_rate))
    except GsganError:
        raise
    # The package raises whatever its parsing meets in a damaged file.
    except Exception as error:
        raise DataError(
            f"{path} cannot be read as a .c3d file ({error})"
        ) from None

    # A point has three coordinates, a residual that is negative if it was not seen, and a number of
    # cameras. Names of groups come before a colon, as in a .trc file.
    points = np.array([points[: len(names)] for _, points in read], np.float64)
    points = points.reshape(len(read), -1, 5)
    places = np.where(points[..., 3:4] < 0, np.nan, points[..., :3])
    return Markers(
        frames=np.array([number for number, _ in read], np.int64),
        names=names[: places.shape[1]],
        places=places,
        unit=None if unit is None else unit.string_value.strip() or None,
        fps=fps,
    )


def _numbers(line: str, count: int) -> list[float]:
    """The numbers of a line; NaN for an empty or missing cell."""
    numbers = [np.nan] * count
    for column, cell in enumerate(line.split("\t")[:count]):
        if cell.strip():
            numbers[column] = float(cell)
    return numbers


def _metres(p: Float) -> float:
    """Metres in the unit of joints ``[F, 33, 3]``: the trunk then has nearly its usual length."""
    trunk = p[:, LEFT_RIGHT_SHOULDER] - p[:, LEFT_RIGHT_HIP]
    length = np.nanmedian(np.linalg.norm(trunk, axis=-1))

    def mismatch(scale: float) -> float:
        return float(abs(np.log(scale * length / TRUNK_LENGTH)))

    return min(UNITS.values(), key=mismatch)


def _joint(name: str) -> int | None:
    """The MediaPipe joint of a marker: LShoulder, left_shoulder, Lknee, LBigToe, Nose."""
    # The letters, without a prefix such as "person:".
    _, _, plain_name = name.rpartition(":")
    word = re.sub(r"[^a-z]", "", plain_name.lower())
    word = word.replace("bigtoe", "footindex")

    # "l" and "r" stand for "left" and "right".
    word = re.sub("^r(?!ight)", "right", word)
    word = re.sub("^l(?!eft)", "left", word)
    plain = [name.replace("_", "") for name in MEDIAPIPE33.names]
    return plain.index(word) if word in plain else None
