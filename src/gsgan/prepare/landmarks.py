"""Detected 2D landmarks from files: MediaPipe npz, OpenPose-style JSON, EasyMocap JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.data.files import frame_files, read_arrays, read_json
from gsgan.data.joints import ALL, BODY, FROM_HANDS, HAND, LEFT, RIGHT, SETS
from gsgan.data.skeletons import whole_frame_ids
from gsgan.prepare.rig import Float
from gsgan.utils.arrays import expect_array
from gsgan.utils.errors import DataError

PIXEL_CENTRE = 0.5  # added to detectors that count from the centre of the first pixel
OPENPOSE_KEYS = ("pose_keypoints_2d", "hand_left_keypoints_2d", "hand_right_keypoints_2d")
EASYMOCAP_KEYS = ("keypoints", "handl2d", "handr2d")


@dataclass(frozen=True)
class Detections:
    """What one camera saw of the 75 joints (33 body, 21 left hand, 21 right hand).

    Args:
        frame_id: ``[F]`` rising.
        px: ``[F, 75, 2]`` pixels of the picture as stored, pixel centres at +0.5; NaN = not seen.
        conf: ``[F, 75]`` 0..1, 0 = not seen.
        people: ``[F]`` how many persons were found.
    """

    frame_id: NDArray[np.int64]
    px: Float
    conf: Float
    people: NDArray[np.int64]


def find_landmarks(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """Each camera's npz or folder of JSON files: <camera>.npz, <camera>/, <camera>_json/.

    Raises:
        DataError: when a camera has none, listing what is there.
    """
    if not folder.is_dir():
        raise DataError(f"landmarks={folder} is no folder; expected <camera>.npz or <camera>_json/")
    found = {}
    for name in names:
        places = [folder / f"{name}.npz", folder / f"{name}_json", folder / name]
        existing = [p for p in places if p.exists()]
        if not existing:
            there = ", ".join(sorted(p.name for p in folder.iterdir())[:20]) or "nothing"
            raise DataError(
                f"{folder} has no landmarks of the camera {name}; expected {name}.npz, "
                f"{name}_json/ or {name}/, found {there}"
            )
        found[name] = existing[0]
    return found


def read_detections(path: Path) -> Detections:
    """Detections of one camera from an npz or a folder of JSON files.

    Raises:
        DataError: on a damaged file or a set of joints that is not known.
    """
    detections = _read_folder(path) if path.is_dir() else _read_npz(path)
    order = np.argsort(detections.frame_id)
    conf = np.where(np.isfinite(detections.px).all(-1), np.nan_to_num(detections.conf), 0.0)
    conf = np.clip(conf, 0.0, 1.0)[order]
    px = np.where(conf[..., None] > 0, detections.px[order], np.nan)
    return Detections(detections.frame_id[order], px, conf, detections.people[order])


def _read_npz(path: Path) -> Detections:
    arrays = read_arrays(path, ("px", "conf", "left", "right", "frame_id"))
    body = expect_array(arrays, "px", (None, BODY, 2), path).astype(np.float64)
    F = len(body)
    frame_id = whole_frame_ids(expect_array(arrays, "frame_id", (F,), path), str(path))
    px, conf = np.full((F, ALL, 2), np.nan), np.zeros((F, ALL))
    px[:, :BODY], conf[:, :BODY] = body, expect_array(arrays, "conf", (F, BODY), path)
    for name, part in (("left", LEFT), ("right", RIGHT)):
        if name in arrays:
            px[:, part] = expect_array(arrays, name, (F, HAND, 2), path)
            conf[:, part] = 1.0  # MediaPipe says nothing of a hand's joints one by one
    people = np.asarray((conf[:, :BODY] > 0).any(1), np.int64)
    return Detections(frame_id, px, conf, people)


def _read_folder(path: Path) -> Detections:
    files = frame_files(path.parent, path.name, (".json",))
    if not files:
        raise DataError(f"{path} holds no JSON files; expected one a frame")
    frames = [_read_frame(path.parent / file) for file in files.values()]
    return Detections(
        frame_id=np.array(list(files), np.int64),
        px=np.stack([px for px, _, _ in frames]),
        conf=np.stack([conf for _, conf, _ in frames]),
        people=np.array([people for _, _, people in frames], np.int64),
    )


def _read_frame(path: Path) -> tuple[Float, Float, int]:
    content = read_json(path)
    if isinstance(content.get("people"), list):
        keys, people = OPENPOSE_KEYS, content["people"]
    elif isinstance(content.get("annots"), list):
        keys, people = EASYMOCAP_KEYS, content["annots"]
    else:
        raise DataError(f"{path} has neither 'people' (OpenPose) nor 'annots' (EasyMocap)")
    read = [_person(path, person, keys) for person in people]
    if not read:
        return np.full((ALL, 2), np.nan), np.zeros(ALL), 0
    px, conf = max(read, key=lambda one: float(one[1].sum()))  # who is seen best
    return px, conf, len(read)


def _person(path: Path, person: Any, keys: tuple[str, ...]) -> tuple[Float, Float]:
    if not isinstance(person, Mapping):
        raise DataError(f"{path}: a person must be an object, found {type(person).__name__}")
    px, conf = np.full((ALL, 2), np.nan), np.zeros(ALL)
    body = _triples(path, person, keys[0])
    if len(body):
        if len(body) not in SETS:
            known = ", ".join(f"{n} ({name})" for n, (name, _) in SETS.items())
            raise DataError(f"{path}: '{keys[0]}' holds {len(body)} joints; known are {known}")
        numbers = SETS[len(body)][1]
        _put(px, conf, list(numbers), body[list(numbers.values())])
    for key, part in zip(keys[1:], (LEFT, RIGHT), strict=True):
        hand = _triples(path, person, key)
        if len(hand) == HAND:
            _put(px, conf, list(range(part.start, part.stop)), hand)
    for target, origin in FROM_HANDS.items():
        if conf[target] == 0:
            px[target], conf[target] = px[origin], conf[origin]
    return px, conf


def _put(px: Float, conf: Float, joints: list[int], triples: Float) -> None:
    seen = np.isfinite(triples).all(-1) & (triples[:, 2] > 0)
    px[joints] = np.where(seen[:, None], triples[:, :2] + PIXEL_CENTRE, np.nan)
    conf[joints] = np.where(seen, triples[:, 2], 0.0)


def _triples(path: Path, person: Mapping[str, Any], key: str) -> Float:
    """``[n, 3]`` x, y, confidence; OpenPose writes them flat, EasyMocap in rows."""
    try:
        flat = np.array(person.get(key) or [], np.float64).reshape(-1)
    except (TypeError, ValueError, OverflowError):
        flat = np.zeros(1)
    if len(flat) % 3:
        raise DataError(f"{path}: '{key}' must hold x, y, confidence for every joint")
    return flat.reshape(-1, 3)


def gather(
    detections: Mapping[str, Detections], offsets: Mapping[str, int]
) -> tuple[NDArray[np.int64], Float, Float]:
    """All cameras' detections on one clock.

    Args:
        detections: by camera.
        offsets: frames to add to a camera's numbers to get the common ones.

    Returns:
        ``frames [F]`` rising, those of any camera; ``px [C, F, 75, 2]`` NaN = not seen;
        ``conf [C, F, 75]``.
    """
    clocks = [d.frame_id + int(offsets.get(name, 0)) for name, d in detections.items()]
    frames = np.unique(np.concatenate(clocks))
    frames = frames[frames >= 0]  # file names hold no negative numbers
    px = np.full((len(clocks), len(frames), ALL, 2), np.nan)
    conf = np.zeros(px.shape[:3])
    for c, (clock, seen) in enumerate(zip(clocks, detections.values(), strict=True)):
        at = np.searchsorted(frames, clock[clock >= 0])
        px[c, at], conf[c, at] = seen.px[clock >= 0], seen.conf[clock >= 0]
    return frames, px, conf
