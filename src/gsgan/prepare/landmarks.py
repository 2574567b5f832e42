"""Landmarks from files: 2D of MediaPipe, OpenPose, EasyMocap; 3D of Pose2Sim and EasyMocap."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsgan.data.files import frame_files, read_arrays, read_json, read_json_value
from gsgan.data.joints import ALL, BODY, FACE, FACE_MESH, FROM_HANDS, LEFT, RIGHT, SETS
from gsgan.data.skeletons import whole_frame_ids
from gsgan.prepare.rig import Float, Ints, known
from gsgan.skeleton.hands import HAND
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.arrays import expect_array
from gsgan.utils.errors import DataError

MESH = 468  # landmarks of MediaPipe's face mesh
PIXEL_CENTRE = 0.5  # added to detectors that count from the centre of the first pixel
OPENPOSE_KEYS = ("pose_keypoints_2d", "hand_left_keypoints_2d", "hand_right_keypoints_2d")
EASYMOCAP_KEYS = ("keypoints", "handl2d", "handr2d")
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
TRC_HEADER = 5  # lines before the first frame; markers are named in the fourth
TRC_AXES = [2, 0, 1]  # Pose2Sim writes (y, z, x) so that y is up: columns of x, y, z
Numbered = tuple[Ints, Float, Float]  # frame numbers, coordinates, confidence


@dataclass(frozen=True)
class Detections:
    """One camera's detections of the J joints: 33 body, 21 left hand, 21 right hand, 30 face."""

    frame_id: Ints  # [F] rising
    px: Float  # [F, J, 2] pixels of the image as stored, pixel centres at +0.5; NaN = not seen
    conf: Float  # [F, J] in [0, 1], 0 = not seen
    people: Ints  # [F] number of persons found


def find_landmarks(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """Each camera's npz or folder of JSON files: <camera>.npz, <camera>/, <camera>_json/.

    Raises:
        DataError: when a camera has none, listing those found.
    """
    there = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
    found = {}
    for name in names:
        existing = [end for end in (f"{name}.npz", f"{name}_json", name) if end in there]
        if not existing:
            raise DataError(
                f"{folder} has no landmarks of the camera {name}, such as {name}.npz or "
                f"{name}_json/, found {', '.join(there[:20]) or 'nothing'}"
            )
        found[name] = folder / existing[0]
    return found


def read_detections(path: Path) -> Detections:
    """Detections of one camera from an npz or a folder of JSON files.

    Raises:
        DataError: on a damaged file or an unknown set of joints.
    """
    if path.is_dir():
        files = _json_files(path)
        px, conf, people = map(np.array, zip(*map(_read_frame, files.values()), strict=True))
        frames = np.array(list(files))
    else:
        frames, px, conf = _read_npz(path)
        people = np.asarray((conf[:, :BODY] > 0).any(1), np.int64)
    order = np.argsort(frames)
    conf = np.where(known(px), np.nan_to_num(conf), 0.0)
    conf = np.clip(conf, 0.0, 1.0)[order]
    px = np.where(conf[..., None] > 0, px[order], np.nan)
    return Detections(frames[order], px, conf, people[order])


def gather(
    detections: Mapping[str, Detections], offsets: Mapping[str, int]
) -> tuple[Ints, Float, Float]:
    """All cameras' detections by common frame numbers, a camera's own plus its offset.

    Returns:
        ``frames [F]`` rising, those of any camera; ``px [C, F, J, 2]`` NaN = not seen;
        ``conf [C, F, J]``.
    """
    ids = [d.frame_id + int(offsets.get(name, 0)) for name, d in detections.items()]
    frames = np.unique(np.concatenate(ids))
    frames = frames[frames >= 0]  # file names hold no negative numbers
    px = np.full((len(ids), len(frames), ALL, 2), np.nan)
    conf = np.zeros(px.shape[:3])
    for c, (own, seen) in enumerate(zip(ids, detections.values(), strict=True)):
        at = np.searchsorted(frames, own[own >= 0])
        px[c, at], conf[c, at] = seen.px[own >= 0], seen.conf[own >= 0]
    return frames, px, conf


def inside(px: Float, conf: Float, sizes: Float) -> tuple[Float, Float]:
    """Detections without those outside their image: detectors guess where a cut-off body goes on.

    ``px [C, F, J, 2]``, ``conf [C, F, J]`` and ``sizes [C, 2]``, width and height.
    """
    with np.errstate(invalid="ignore"):
        seen = np.asarray(((px >= 0) & (px < sizes[:, None, None])).all(-1))
    return np.where(seen[..., None], px, np.nan), np.where(seen, conf, 0.0)


def _read_npz(path: Path) -> Numbered:
    arrays = read_arrays(path, ("px", "conf", "left", "right", "face", "frame_id"))
    body = expect_array(arrays, "px", (None, BODY, 2), path).astype(np.float64)
    F = len(body)
    frame_id = whole_frame_ids(expect_array(arrays, "frame_id", (F,), path), str(path))
    px, conf = np.full((F, ALL, 2), np.nan), np.zeros((F, ALL))
    px[:, :BODY], conf[:, :BODY] = body, expect_array(arrays, "conf", (F, BODY), path)
    for name, part in (("left", LEFT), ("right", RIGHT)):
        if name in arrays:
            px[:, part] = expect_array(arrays, name, (F, HAND, 2), path)
            conf[:, part] = 1.0  # MediaPipe has no confidence per landmark of hands and face
    if "face" in arrays:
        mesh = expect_array(arrays, "face", (F, MESH, 2), path)
        px[:, FACE], conf[:, FACE] = mesh[:, list(FACE_MESH.values())], 1.0
    return frame_id, px, conf


def _json_files(path: Path) -> dict[int, Path]:
    files = frame_files(path.parent, path.name, (".json",))
    if not files:
        raise DataError(f"{path} holds no JSON files; expected one per frame, numbered")
    return {number: path.parent / files[number] for number in sorted(files)}


def _read_frame(path: Path) -> tuple[Float, Float, int]:
    content = read_json(path)
    if isinstance(content.get("people"), list):
        keys, people = OPENPOSE_KEYS, content["people"]
    elif isinstance(content.get("annots"), list):
        keys, people = EASYMOCAP_KEYS, content["annots"]
    else:
        raise DataError(f"{path} has neither 'people' (OpenPose) nor 'annots' (EasyMocap)")
    try:
        read = [_person(person, keys) for person in people]
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        sets = ", ".join(f"{n} ({name})" for n, (name, _) in SETS.items())
        raise DataError(
            f"{path}: a person must hold '{keys[0]}' with x, y, confidence of {sets} joints "
            f"({error})"
        ) from None
    if not read:
        return np.full((ALL, 2), np.nan), np.zeros(ALL), 0
    px, conf = max(read, key=lambda one: float(one[1].sum()))  # the person seen best
    return px, conf, len(read)


def _person(person: Mapping[str, Any], keys: tuple[str, ...]) -> tuple[Float, Float]:
    px, conf = np.full((ALL, 2), np.nan), np.zeros(ALL)

    def put(joints: list[int], triples: Float) -> None:
        seen = known(triples) & (triples[:, 2] > 0)
        px[joints] = np.where(seen[:, None], triples[:, :2] + PIXEL_CENTRE, np.nan)
        conf[joints] = np.where(seen, triples[:, 2], 0.0)

    # OpenPose writes triples flat, EasyMocap in rows.
    body, *hands = (np.array(person.get(k) or [], np.float64).reshape(-1, 3) for k in keys)
    if len(body):
        numbers = SETS[len(body)][1]
        put(list(numbers), body[list(numbers.values())])
    for hand, part in zip(hands, (LEFT, RIGHT), strict=True):
        if len(hand) == HAND:
            put(list(range(part.start, part.stop)), hand)
    for target, origin in FROM_HANDS.items():
        if conf[target] == 0:
            px[target], conf[target] = px[origin], conf[origin]
    return px, conf


def read_points3d(path: Path) -> Numbered:
    """3D joints that another tool triangulated: a .trc file, or a folder of EasyMocap JSON files.

    Returns:
        ``frames [F]`` rising; ``p [F, 33, 3]`` metres, in the calibration's world, NaN = missing,
        as exact zeros are; ``conf [F, 33]``, 0 = missing.

    Raises:
        DataError: when it is neither, damaged, or without shoulders and hips.
    """
    if path.is_dir():
        files = _json_files(path)
        both = np.stack([_read_people(file) for file in files.values()])
        frames, p, conf = np.array(list(files)), both[..., :3], both[..., 3]
    else:
        frames, p, conf = _read_trc(path)
    order = np.argsort(frames)
    p = np.where((p == 0).all(-1, keepdims=True), np.nan, p)[order]
    conf = np.where(known(p), conf[order], 0.0)
    p = np.where((conf > 0)[..., None], p, np.nan)
    if not (conf[:, [11, 12, 23, 24]] > 0).any():
        raise DataError(f"{path} has no shoulders and hips; expected a whole body's joints")
    return frames[order], p, conf


def without_frozen(p: Float, frames: int) -> tuple[Float, int]:
    """Points ``p [F, J, 3]`` without gaps that another tool filled, and how many were removed.

    Of a run of exactly equal points, ``frames`` long or longer, only the first stays.
    """
    same = np.zeros(p.shape[:2], bool)
    same[1:] = (np.diff(p, axis=0) == 0).all(-1)
    frozen = np.zeros_like(same)
    for j in range(p.shape[1]):
        edges = np.flatnonzero(np.diff(np.r_[False, same[:, j], False]))
        for start, end in edges.reshape(-1, 2):
            frozen[start:end, j] = end - start + 1 >= frames
    return np.where(frozen[..., None], np.nan, p), int(frozen.sum())


def _read_trc(path: Path) -> Numbered:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        names, values = lines[1].split(), lines[2].split()
        markers = [name for name in lines[3].split("\t")[2:] if name]
        count = 2 + 3 * len(markers)  # frame, time and the coordinates; an empty cell is missing
        rows = [
            [
                float(cell) if cell.strip() else np.nan
                for cell in (line.split("\t") + [""] * count)[:count]
            ]
            for line in lines[TRC_HEADER:]
            if line.strip()
        ]
        unit = values[names.index("Units")]
    except (OSError, ValueError, IndexError) as error:
        raise DataError(f"{path} cannot be read as a .trc file ({error})") from None
    if unit not in UNITS:
        raise DataError(f"{path}: Units is {unit!r}; expected one of {', '.join(UNITS)}")
    table = np.array(rows).reshape(-1, count)
    read = table[:, 2:].reshape(len(table), len(markers), 3)[..., TRC_AXES] * UNITS[unit]
    p = np.full((len(table), BODY, 3), np.nan)
    for marker, name in enumerate(markers):
        if (joint := _joint(name)) is not None:
            p[:, joint] = read[:, marker]
    return whole_frame_ids(table[:, 0], str(path)), p, np.ones(p.shape[:2])


def _joint(name: str) -> int | None:
    """The MediaPipe joint of a marker: LShoulder, left_shoulder, Lknee, LBigToe, Nose."""
    word = re.sub(r"[^a-z]", "", name.lower()).replace("bigtoe", "footindex")
    word = re.sub("^l(?!eft)", "left", re.sub("^r(?!ight)", "right", word))
    plain = [name.replace("_", "") for name in MEDIAPIPE33.names]
    return plain.index(word) if word in plain else None


def _read_people(path: Path) -> Float:
    """``[33, 4]`` x, y, z, confidence of the person seen best; EasyMocap's zeros stay zeros."""
    best, numbers = np.zeros((BODY, 4)), SETS[25][1]
    try:
        for person in read_json_value(path):
            joints = np.array(person["keypoints3d"], np.float64)[list(numbers.values())]
            if joints.shape[1] == 3:
                joints = np.c_[joints, np.ones(len(joints))]
            if joints[:, 3].sum() > best[:, 3].sum():
                best[list(numbers)] = joints
    except (ArithmeticError, ValueError, TypeError, LookupError) as error:
        raise DataError(
            f"{path} is not an EasyMocap keypoints3d file: expected a list of persons with "
            f"(25, 4) numbers each ({error})"
        ) from None
    return best
