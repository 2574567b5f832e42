"""3D joints that another tool triangulated: Pose2Sim's .trc, EasyMocap's keypoints3d."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.data.files import frame_files
from gsgan.data.joints import BODY, SETS
from gsgan.data.skeletons import whole_frame_ids
from gsgan.prepare.rig import Float, known
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.errors import DataError

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
TRC_HEADER = 5  # lines before the first frame; markers are named in the fourth
TRC_AXES = [2, 0, 1]  # Pose2Sim writes (y, z, x) so that y is up: where x, y, z stand in a row
SAME = {"bigtoe": "footindex"}  # other tools' words, without side


@dataclass(frozen=True)
class Points3D:
    """Joints as the other tool found them.

    Args:
        frame_id: ``[F]`` rising.
        p: ``[F, 33, 3]`` metres, in the calibration's world; NaN = missing.
        conf: ``[F, 33]`` 0 = missing.
    """

    frame_id: NDArray[np.int64]
    p: Float
    conf: Float


def read_points3d(path: Path) -> Points3D:
    """Joints from a .trc file or a folder of EasyMocap JSON files; exact zeros are missing.

    Raises:
        DataError: when it is neither, damaged, or knows no shoulders and hips.
    """
    points = _read_folder(path) if path.is_dir() else _read_trc(path)
    order = np.argsort(points.frame_id)
    p = np.where((points.p == 0).all(-1, keepdims=True), np.nan, points.p)[order]
    conf = np.where(known(p), points.conf[order], 0.0)
    p = np.where((conf > 0)[..., None], p, np.nan)
    if not (conf[:, [11, 12, 23, 24]] > 0).any():
        raise DataError(f"{path} has no shoulders and hips; expected a whole body's joints")
    return Points3D(points.frame_id[order], p, conf)


def without_frozen(p: Float, frames: int) -> tuple[Float, int]:
    """Points without those that stay the same to the last digit: gaps that were filled.

    Args:
        p: ``[F, J, 3]``, NaN = missing.
        frames: so many in a row, or more, are taken out but for the first.

    Returns:
        The points, and how many were taken out.
    """
    same = np.zeros(p.shape[:2], bool)
    same[1:] = (np.diff(p, axis=0) == 0).all(-1)
    frozen = np.zeros_like(same)
    for j in range(p.shape[1]):
        edges = np.flatnonzero(np.diff(np.r_[False, same[:, j], False]))
        for start, end in edges.reshape(-1, 2):
            frozen[start:end, j] = end - start + 1 >= frames
    return np.where(frozen[..., None], np.nan, p), int(frozen.sum())


def _read_trc(path: Path) -> Points3D:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path} cannot be read as a .trc file ({error})") from None
    if len(lines) <= TRC_HEADER or "Units" not in lines[1]:
        raise DataError(f"{path} is no .trc file; expected five lines of header, then frames")
    header = dict(zip(lines[1].split(), lines[2].split(), strict=False))
    unit = header.get("Units")
    if unit not in UNITS:
        raise DataError(f"{path}: Units is {unit!r}; expected one of {', '.join(UNITS)}")
    markers = [name for name in lines[3].rstrip("\t").split("\t")[2:] if name]
    rows = [_numbers(path, line, len(markers)) for line in lines[TRC_HEADER:] if line.strip()]
    table = np.array(rows).reshape(-1, 2 + 3 * len(markers))
    read = table[:, 2:].reshape(len(table), len(markers), 3)[..., TRC_AXES] * UNITS[unit]
    p = np.full((len(table), BODY, 3), np.nan)
    for marker, name in enumerate(markers):
        if (joint := _joint(name)) is not None:
            p[:, joint] = read[:, marker]
    return Points3D(whole_frame_ids(table[:, 0], str(path)), p, np.ones(p.shape[:2]))


def _numbers(path: Path, line: str, markers: int) -> list[float]:
    """Frame, time and the markers' coordinates; an empty cell is missing."""
    cells = line.split("\t")
    cells = (cells + [""] * (2 + 3 * markers))[: 2 + 3 * markers]
    try:
        numbers = [float(cell) if cell.strip() else np.nan for cell in cells]
    except ValueError as error:
        raise DataError(f"{path}: a frame holds no numbers ({error})") from None
    if not np.isfinite(numbers[0]):
        raise DataError(f"{path}: a line has no frame number")
    return numbers


def _joint(name: str) -> int | None:
    """The MediaPipe joint a marker means: LShoulder, left_shoulder, Lknee, LBigToe, Nose."""
    word = re.sub(r"[^a-z]", "", name.lower())
    side = re.match(r"left|right|l(?!eft)|r(?!ight)", word)
    if word == "nose" or side is None:
        return 0 if word == "nose" else None
    part = word[side.end() :]
    wanted = ("left" if side[0][0] == "l" else "right") + SAME.get(part, part)
    plain = [joint.replace("_", "") for joint in MEDIAPIPE33.names]
    return plain.index(wanted) if wanted in plain else None


def _read_folder(path: Path) -> Points3D:
    files = dict(sorted(frame_files(path.parent, path.name, (".json",)).items()))
    if not files:
        raise DataError(f"{path} holds no JSON files; expected one a frame, numbered")
    frames = [_read_people(path.parent / file) for file in files.values()]
    ids = np.array(list(files), np.int64)
    both = np.stack(frames)
    return Points3D(ids, both[..., :3], both[..., 3])


def _read_people(path: Path) -> Float:
    """``[33, 4]`` x, y, z, confidence of the person seen best; EasyMocap's zeros stay zeros."""
    try:
        people: Any = json.loads(path.read_text(encoding="utf-8"))
        read = [np.array(person["keypoints3d"], np.float64) for person in people]
    except (OSError, ArithmeticError, ValueError, TypeError, LookupError, RecursionError) as error:
        raise DataError(
            f"{path} is no EasyMocap keypoints3d file: expected a list of persons ({error})"
        ) from None
    out, numbers = np.zeros((BODY, 4)), SETS[25][1]
    for joints in read:
        if joints.ndim != 2 or len(joints) < 25 or joints.shape[1] not in (3, 4):
            raise DataError(f"{path}: keypoints3d has shape {joints.shape}; expected (25, 4)")
        if joints.shape[1] == 3:
            joints = np.c_[joints, np.ones(len(joints))]
        body = joints[list(numbers.values())]
        if body[:, 3].sum() > out[:, 3].sum():
            out[list(numbers)] = body
    return out
