"""3D joints that Pose2Sim triangulated: .trc files."""

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsgan.data.files import frame_files
from gsgan.data.joints import BODY, known, zeros_as_missing
from gsgan.data.skeletons import whole_frame_ids
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.errors import DataError
from gsgan.utils.files import read_text

Float = NDArray[np.float64]
Ints = NDArray[np.int64]
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
TRUNK = [11, 12, 23, 24]  # shoulders and hips
TRUNK_LENGTH = 0.5  # metres from shoulder to hip
TRC_HEADER = 5  # lines before the first frame; markers are named in the fourth
TRC_AXES = [2, 0, 1]  # Pose2Sim writes (y, z, x) so that y is up: columns of x, y, z
Numbered = tuple[Ints, Float, Float]  # frame numbers, coordinates, confidence


def json_files(path: Path) -> dict[int, Path]:
    files = frame_files(path.parent, path.name, (".json",))
    if not files:
        raise DataError(f"{path} holds no JSON files; expected one per frame, numbered")
    return {number: path.parent / files[number] for number in sorted(files)}


def read_points3d(path: Path) -> Numbered:
    """3D joints of a .trc file.

    Returns:
        ``frames [F]`` rising; ``p [F, 33, 3]`` metres, in the calibration's world, NaN = missing,
        as exact zeros are; ``conf [F, 33]``, 0 = missing.

    Raises:
        DataError: when it is damaged, or without shoulders and hips.
    """
    frames, p, conf = _read_trc(path)
    order = np.argsort(frames)
    p = p[order]
    conf = np.where(known(p), conf[order], 0.0)
    p = np.where((conf > 0)[..., None], p, np.nan)
    return frames[order], p, conf


def _read_trc(path: Path) -> Numbered:
    try:
        lines = read_text(path).splitlines()
        names = lines[1].split()
        values = lines[2].split()
        markers = [name for name in lines[3].split("\t")[2:] if name]
        # frame, time and the coordinates; an empty cell is missing
        count = 2 + 3 * len(markers)
        rows = [
            [
                float(cell) if cell.strip() else np.nan
                for cell in (line.split("\t") + [""] * count)[:count]
            ]
            for line in lines[TRC_HEADER:]
            if line.strip()
        ]
        unit = dict(zip(names, values, strict=False)).get("Units")
    except (OSError, ValueError, IndexError) as error:
        raise DataError(f"{path} cannot be read as a .trc file ({error})") from None
    # a number: Units is left out
    given = unit is not None and not re.fullmatch(r"[\d.]+", unit)
    if given and unit not in UNITS:
        raise DataError(
            f"{path}: Units is {unit!r}; expected one of {', '.join(UNITS)}"
        )
    table = np.array(rows).reshape(-1, count)
    read = table[:, 2:].reshape(len(table), len(markers), 3)[..., TRC_AXES]
    p = np.full((len(table), BODY, 3), np.nan)
    for marker, name in enumerate(markers):
        if (joint := _joint(name)) is not None:
            p[:, joint] = read[:, marker]
    p = zeros_as_missing(p)
    if not np.isfinite(p[:, TRUNK]).any():
        raise DataError(
            f"{path} has no shoulders and hips; expected markers such as LShoulder and LHip, found "
            f"{', '.join(markers)}"
        )
    p = p * (UNITS[str(unit)] if given else _metres(p))
    return whole_frame_ids(table[:, 0], str(path)), p, np.ones(p.shape[:2])


def _metres(p: Float) -> float:
    """Metres in the unit of joints ``[F, 33, 3]``: the trunk then has nearly its usual length."""
    trunk = np.nanmedian(np.linalg.norm(p[:, [11, 12]] - p[:, [23, 24]], axis=-1))
    return min(
        UNITS.values(), key=lambda scale: abs(np.log(scale * trunk / TRUNK_LENGTH))
    )


def _joint(name: str) -> int | None:
    """The MediaPipe joint of a marker: LShoulder, left_shoulder, Lknee, LBigToe, Nose."""
    word = re.sub(r"[^a-z]", "", name.split(":")[-1].lower()).replace(
        "bigtoe", "footindex"
    )
    word = re.sub("^l(?!eft)", "left", re.sub("^r(?!ight)", "right", word))
    plain = [name.replace("_", "") for name in MEDIAPIPE33.names]
    return plain.index(word) if word in plain else None
