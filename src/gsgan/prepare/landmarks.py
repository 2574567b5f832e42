"""2D landmarks from the files of MediaPipe, OpenPose and EasyMocap."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsgan.data.files import read_arrays, read_json
from gsgan.data.joints import (
    ALL,
    BODY,
    BODY_25B,
    FACE,
    FACE_MESH,
    FROM_HANDS,
    LEFT,
    RIGHT,
    SETS,
    known,
)
from gsgan.data.skeletons import whole_frame_ids
from gsgan.motion.points import Numbered, json_files
from gsgan.skeleton.hands import HAND
from gsgan.utils.arrays import Float, Ints, expect_array
from gsgan.utils.errors import DataError

MIDDLE_OF_HIPS = 0.35  # of the trunk: farther from it joint 8 is another one
MESH = 468  # landmarks of MediaPipe's face mesh
PIXEL_CENTRE = 0.5  # added to detectors that count from the centre of the first pixel
OPENPOSE_KEYS = (
    "pose_keypoints_2d",
    "hand_left_keypoints_2d",
    "hand_right_keypoints_2d",
)
EASYMOCAP_KEYS = ("keypoints", "handl2d", "handr2d")


@dataclass(frozen=True)
class Detections:
    """One camera's detections of the J joints: 33 body, 21 left hand, 21 right hand, 30 face."""

    frame_id: Ints  # [F] rising
    # [F, J, 2] pixels of the image as stored, pixel centres at +0.5; NaN = not seen
    px: Float
    conf: Float  # [F, J] in [0, 1], 0 = not seen


def find_landmarks(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """Each camera's npz or folder of JSON files: <camera>.npz, <camera>/, <camera>_json/.

    Raises:
        DataError: when a camera has none, listing those found.
    """
    there = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
    found = {}
    for name in names:
        existing = [
            end for end in (f"{name}.npz", f"{name}_json", name) if end in there
        ]
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
        files = json_files(path)
        people = [_read_people(file) for file in files.values()]
        # the person seen best
        best = [max(found, key=_seen, default=None) for found in people]
        bodies = [person.body for person in best if person is not None]
        numbers = joint_numbers(bodies)
        read = [_joints(person, numbers) for person in best]
        px, conf = map(np.array, zip(*read, strict=True))
        frames = np.array(list(files))
    else:
        frames, px, conf = _read_npz(path)
    order = np.argsort(frames)
    conf = np.where(known(px), np.nan_to_num(conf), 0.0)
    conf = np.clip(conf, 0.0, 1.0)[order]
    px = np.where(conf[..., None] > 0, px[order], np.nan)
    return Detections(frames[order], px, conf)


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
        px[c, at] = seen.px[own >= 0]
        conf[c, at] = seen.conf[own >= 0]
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
    px = np.full((F, ALL, 2), np.nan)
    conf = np.zeros((F, ALL))
    px[:, :BODY] = body
    conf[:, :BODY] = expect_array(arrays, "conf", (F, BODY), path)
    for name, part in (("left", LEFT), ("right", RIGHT)):
        if name in arrays:
            px[:, part] = expect_array(arrays, name, (F, HAND, 2), path)
            # MediaPipe has no confidence per landmark of hands and face
            conf[:, part] = 1.0
    if "face" in arrays:
        mesh = expect_array(arrays, "face", (F, MESH, 2), path)
        px[:, FACE] = mesh[:, list(FACE_MESH.values())]
        conf[:, FACE] = 1.0
    return frame_id, px, conf


class _Person(NamedTuple):
    """What a file has of a person: rows of x, y, confidence; none where a part is missing."""

    body: Float
    left: Float
    right: Float


def _seen(person: _Person) -> float:
    """By how much confidence a person is seen."""
    return sum(float(part[:, 2].clip(0).sum()) for part in person)


def _read_people(path: Path) -> list[_Person]:
    """The people of a file of OpenPose or EasyMocap.

    Raises:
        DataError: if it is neither, or a person does not hold joints of a known set.
    """
    content = read_json(path)
    if isinstance(content.get("people"), list):
        keys = OPENPOSE_KEYS
        people = content["people"]
    elif isinstance(content.get("annots"), list):
        keys = EASYMOCAP_KEYS
        people = content["annots"]
    else:
        raise DataError(
            f"{path} has neither 'people' (OpenPose) nor 'annots' (EasyMocap)"
        )
    try:
        return [_person(person, keys) for person in people if person is not None]
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        TypeError,
        ValueError,
    ) as error:
        sets = ", ".join(f"{n} ({name})" for n, (name, _) in SETS.items())
        raise DataError(
            f"{path}: a person must hold '{keys[0]}' with x, y, confidence of {sets} joints "
            f"({error})"
        ) from None


def _person(person: Mapping[str, Any], keys: tuple[str, ...]) -> _Person:
    # OpenPose of 2017 had names without _2d.
    if not {keys[0], keys[0].removesuffix("_2d")} & person.keys():
        raise KeyError(f"found {', '.join(person)}")
    found = [
        person.get(key) or person.get(key.removesuffix("_2d")) or [] for key in keys
    ]
    # OpenPose writes triples flat, EasyMocap in rows.
    parts = [np.array(values, np.float64).reshape(-1, 3) for values in found]
    if len(parts[0]) and len(parts[0]) not in SETS:
        raise LookupError(len(parts[0]))
    return _Person(*parts)


def joint_numbers(bodies: Sequence[Float]) -> dict[int, dict[int, int]]:
    """The numbers of MediaPipe's joints in bodies of each count of joints.

    Two sets have 25 joints. Joint 8 of BODY_25 is the middle of the hips, joints 9 and 12; of
    BODY_25B it is an elbow.

    Args:
        bodies: ``[n, 3]`` x, y, confidence of a person, in all frames.
    """
    numbers = {count: joints for count, (_, joints) in SETS.items()}
    distances = []
    for body in bodies:
        if len(body) == 25 and (body[[1, 8, 9, 12], 2] > 0).all():
            neck, middle, right, left = body[[1, 8, 9, 12], :2]
            trunk = np.linalg.norm(neck - (left + right) / 2)
            distances.append(
                np.linalg.norm(middle - (left + right) / 2) / max(float(trunk), 1e-6)
            )
    if distances and np.median(distances) > MIDDLE_OF_HIPS:
        numbers[25] = BODY_25B
    return numbers


def _joints(
    person: _Person | None, numbers: Mapping[int, Mapping[int, int]]
) -> tuple[Float, Float]:
    """Pixels ``[J, 2]`` and confidence ``[J]`` of a person; NaN and 0 of nobody."""
    px = np.full((ALL, 2), np.nan)
    conf = np.zeros(ALL)
    if person is None:
        return px, conf

    def put(joints: list[int], triples: Float) -> None:
        seen = known(triples) & (triples[:, 2] > 0)
        px[joints] = np.where(seen[:, None], triples[:, :2] + PIXEL_CENTRE, np.nan)
        conf[joints] = np.where(seen, triples[:, 2], 0.0)

    if len(person.body):
        joints = numbers[len(person.body)]
        put(list(joints), person.body[list(joints.values())])
    for hand, part in ((person.left, LEFT), (person.right, RIGHT)):
        if len(hand) == HAND:
            put(list(range(part.start, part.stop)), hand)
    for target, origin in FROM_HANDS.items():
        if conf[target] == 0:
            px[target] = px[origin]
            conf[target] = conf[origin]
    return px, conf
