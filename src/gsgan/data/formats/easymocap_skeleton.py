"""EasyMocap's results by frame: 3D keypoints, or SMPL fits, one JSON file a frame."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.body.smpl import SkinnedModel
from gsgan.data.checks import spans
from gsgan.data.files import frame_files, read_json_value
from gsgan.data.formats.smpl_motion import Motion
from gsgan.data.formats.zju_params import fit_parameters, to_motion
from gsgan.data.joints import BODY, FROM_HANDS, HAND, SETS
from gsgan.utils.errors import DataError

Float = NDArray[np.float64]

BODY_25 = 25
WITH_HANDS = BODY_25 + 2 * HAND
COUNTS = (BODY_25, WITH_HANDS, WITH_HANDS + 51)  # body; and hands, left first; and face
BODY_25_TO_33 = SETS[BODY_25][1]
HANDS_TO_33 = {landmark: BODY_25 + joint - BODY for landmark, joint in FROM_HANDS.items()}
PEOPLE_KEYS = ("annots", "people")
ID_KEYS = ("id", "personID")


def read_people(
    root: Path, folder: str, frames: Collection[int], person: int, notes: list[str]
) -> dict[int, tuple[str, Mapping[str, Any]]]:
    """One person's entry, and where it stands, by frame.

    Args:
        root: the dataset.
        folder: of the JSON files, relative to it.
        frames: that have pictures.
        person: whose ``id`` is looked for.
        notes: gains how many frames lack the person, or hold others too.

    Raises:
        DataError: on a damaged file, or when the person is in none.
    """
    files = frame_files(root, folder, (".json",))
    found, seen, crowded = {}, set[int](), list[int]()
    there = sorted(set(frames) & set(files))
    for frame in there:
        people = _people(root / files[frame])
        seen |= set(people)
        if len(people) > 1:
            crowded.append(frame)
        if person in people:
            found[frame] = (f"{root / files[frame]}, person {person}", people[person])
    if not found:
        ids = ", ".join(map(str, sorted(seen))) or "nobody"
        raise DataError(
            f"{root / folder} has no person {person} in the {len(there)} of its {len(files)} files "
            f"that belong to pictures (found: {ids}); set data.reader.person"
        )
    if lacking := [frame for frame in there if frame not in found]:
        notes.append(f"{folder} lacks person {person} at frames {spans(lacking)}")
    if crowded:
        notes.append(
            f"{folder} has more people than person {person} at frames {spans(crowded)}; masks must "
            "be of that person alone"
        )
    return found


def _people(path: Path) -> dict[int, Mapping[str, Any]]:
    """Everybody in a file by id."""
    content = read_json_value(path)
    if isinstance(content, Mapping):
        content = next((content[key] for key in PEOPLE_KEYS if key in content), None)
    if not isinstance(content, list) or not all(isinstance(p, Mapping) for p in content):
        raise DataError(f"{path} must hold a list of people, each an object with 'id'")
    found: dict[int, Mapping[str, Any]] = {}
    for entry in content:
        number = next((entry[key] for key in ID_KEYS if key in entry), None)
        if isinstance(number, bool) or not isinstance(number, int) or number in found:
            raise DataError(f"{path}: each person needs a whole 'id' of their own, found {number}")
        found[number] = entry
    return found


def read_keypoints(
    people: Mapping[int, tuple[str, Mapping[str, Any]]],
) -> tuple[NDArray[np.int64], Float, Float]:
    """MediaPipe's 33 landmarks from BODY_25, with hands where they are there.

    Convention: what BODY_25 does not know (corners of the eyes, mouth; without hands also fingers)
    is NaN with confidence 0, and so is what was not seen: EasyMocap writes zeros there.

    Returns:
        ``ids [F]`` rising, ``p [F, 33, 3]`` metres and ``conf [F, 33]``.

    Raises:
        DataError: on another number of joints.
    """
    p, conf = np.full((len(people), BODY, 3), np.nan), np.zeros((len(people), BODY))
    for row, (where, entry) in enumerate(people.values()):
        joints = _joints(where, entry.get("keypoints3d"))
        table = BODY_25_TO_33 | (HANDS_TO_33 if len(joints) > BODY_25 else {})
        taken = joints[list(table.values())]
        seen = np.isfinite(taken).all(axis=1) & (taken[:, 3] > 0)
        to = np.array(list(table))[seen]
        p[row, to], conf[row, to] = taken[seen, :3], taken[seen, 3]
    return np.array(list(people), np.int64), p, conf


def _joints(where: str, raw: Any) -> Float:
    """``[J, 4]`` x, y, z and confidence, which is 1 where the file has none."""
    try:
        joints = np.array(raw, np.float64)
    except (TypeError, ValueError, OverflowError):
        joints = np.zeros(0)
    if joints.ndim != 2 or len(joints) not in COUNTS or joints.shape[1] not in (3, 4):
        counts = ", ".join(map(str, COUNTS))
        raise DataError(
            f"{where}: 'keypoints3d' must have shape (J, 4) with J one of {counts} (BODY_25, with "
            f"hands, with face), found {joints.shape if joints.size else type(raw).__name__}"
        )
    if joints.shape[1] == 3:
        joints = np.concatenate([joints, np.ones((len(joints), 1))], axis=1)
    return joints


def read_fits(
    people: Mapping[int, tuple[str, Mapping[str, Any]]], model: SkinnedModel, notes: list[str]
) -> Motion:
    """SMPL parameters, in the model's own convention.

    Raises:
        DataError: on parameters of a wrong size, or of another body model.
    """
    rows = [fit_parameters(entry, where) for where, entry in people.values()]
    poses, shapes, Rh, Th = (np.stack(column) for column in zip(*rows, strict=True))
    return to_motion(np.array(list(people), np.int64), poses, shapes, Rh, Th, model, notes)
