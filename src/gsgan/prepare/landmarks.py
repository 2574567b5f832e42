"""2D landmarks from the files of MediaPipe, OpenPose and EasyMocap."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gsgan.data.skeletons import whole_frame_ids
from gsgan.motion.points import json_files
from gsgan.skeleton.hands import HAND
from gsgan.skeleton.joints import (
    ALL,
    BODY,
    BODY_25B,
    FACE,
    FACE_MESH,
    FROM_HANDS,
    LEFT,
    RIGHT,
    SETS,
    is_known,
)
from gsgan.utils.arrays import Float, Ints, expect_array
from gsgan.utils.errors import DataError
from gsgan.utils.files import read_json
from gsgan.utils.pickles import read_arrays

# Joint 8 farther than this from the middle of the hips, as a share of the trunk, is another one.
MIDDLE_OF_HIPS = 0.35
UNTOLD = (
    "its 25 joints were read as BODY_25, which cannot be told from BODY_25B: no frame shows neck "
    "and hips"
)
MAX_PEOPLE_SHARE = (
    2.0  # of the image's size: a cut-off body may reach beyond the image
)
MAX_PEOPLE = 5  # of a file, those with most confidence
MESH_LANDMARKS = 468  # landmarks of MediaPipe's face mesh
# added to detectors that count from the centre of the first pixel
PIXEL_CENTRE = 0.5
OPENPOSE_KEYS = (
    "pose_keypoints_2d",
    "hand_left_keypoints_2d",
    "hand_right_keypoints_2d",
)
EASYMOCAP_KEYS = ("keypoints", "handl2d", "handr2d")


@dataclass(frozen=True)
class Detections:
    """One camera's detections of the J joints: 33 body, 21 left hand, 21 right hand, 30 face."""

    frame_id: Ints  # [F] increasing
    # [F, J, 2] pixels of the image as stored, pixel centres at +0.5; NaN = not seen
    px: Float
    conf: Float  # [F, J] in [0, 1], 0 = not seen
    notes: tuple[str, ...] = ()  # what is doubtful, for the user
    # by frame, pixels and confidence of all people, the first as above; None: one at most
    people: Sequence[Sequence[tuple[Float, Float]]] | None = None

    @property
    def crowded(self) -> list[int]:
        """Numbers of the frames with several people."""
        frames = self.frame_id.tolist()
        rows = self.people or ()
        return [frames[row] for row, all_ in enumerate(rows) if len(all_) > 1]


def find_landmarks(folder: Path, names: Iterable[str]) -> dict[str, Path]:
    """Each camera's npz or folder of JSON files: <camera>.npz, <camera>/, <camera>_json/.

    Raises:
        DataError: when a camera has none, listing those found.
    """
    paths = {}
    for name in names:
        for entry in (f"{name}.npz", f"{name}_json", name):
            if (folder / entry).exists():
                paths[name] = folder / entry
                break
        else:
            # The message lists the first entries of the folder.
            there = []
            if folder.is_dir():
                there = sorted(path.name for path in folder.iterdir())
            raise DataError(
                f"{folder} has no landmarks of the camera {name}, such as {name}.npz or "
                f"{name}_json/, found {', '.join(there[:20]) or 'nothing'}"
            )
    return paths


def read_detections(path: Path) -> Detections:
    """Detections of one camera from an npz or a folder of JSON files.

    Raises:
        DataError: on a damaged file or an unknown set of joints.
    """
    # Frames are sorted; NaN, infinity or no confidence mean that a landmark is not seen.
    detections = _read_json(path) if path.is_dir() else _read_npz(path)
    order = np.argsort(detections.frame_id)
    conf = np.where(
        is_known(detections.px), np.nan_to_num(detections.conf), 0.0
    )
    conf = np.clip(conf, 0.0, 1.0)[order]
    px = np.where(conf[..., None] > 0, detections.px[order], np.nan)

    # Some detectors write shares of the image's size.
    seen = px[conf > 0]
    if len(seen) and np.abs(seen).max() <= MAX_PEOPLE_SHARE:
        raise DataError(
            f"{path}: all landmarks are between {seen.min():.2f} and {seen.max():.2f}; expected "
            "pixels of the image, not shares of its size"
        )
    people = detections.people
    if people is not None:
        people = [people[row] for row in order.tolist()]
    return Detections(
        detections.frame_id[order], px, conf, detections.notes, people
    )


class Gathered(NamedTuple):
    """Detections of C cameras in F frames."""

    frames: Ints  # [F] increasing
    px: Float  # [C, F, J, 2] NaN = not seen
    conf: Float  # [C, F, J]


def gather(
    detections: Mapping[str, Detections],
    offsets: Mapping[str, int],
) -> Gathered:
    """Detections of all cameras by common frame numbers: a camera's own plus its offset."""
    ids = []
    for name, detected in detections.items():
        ids.append(detected.frame_id + int(offsets.get(name, 0)))
    frames = np.unique(np.concatenate(ids))
    frames = frames[frames >= 0]  # file names hold no negative numbers

    # Frames that a camera lacks stay NaN.
    px = np.full((len(ids), len(frames), ALL, 2), np.nan)
    conf = np.zeros(px.shape[:3])
    for c, (rows, detected) in enumerate(
        zip(ids, detections.values(), strict=True)
    ):
        valid = rows >= 0
        at = np.searchsorted(frames, rows[valid])
        px[c, at] = detected.px[valid]
        conf[c, at] = detected.conf[valid]
    return Gathered(frames, px, conf)


def inside(px: Float, conf: Float, sizes: Float) -> tuple[Float, Float]:
    """Detections without those outside their image: detectors guess where a cut-off body goes on.

    Args:
        px: ``[C, F, J, 2]``.
        conf: ``[C, F, J]``.
        sizes: ``[C, 2]`` width and height.
    """
    # Comparisons with NaN are false.
    with np.errstate(invalid="ignore"):
        in_image = (px >= 0) & (px < sizes[:, None, None])
    seen = np.asarray(in_image.all(-1))
    shown = np.where(seen[..., None], px, np.nan)
    return shown, np.where(seen, conf, 0.0)


def _read_json(path: Path) -> Detections:
    """Detections in a folder of JSON files; the person with most confidence is the first one."""
    # The people of each file, and the set of joints of all bodies together.
    files = json_files(path)
    detections = []
    for file in files.values():
        seen = [one for one in _read_people(file) if _confidence(one) > 0]
        detections.append(
            sorted(seen, key=_confidence, reverse=True)[:MAX_PEOPLE]
        )
    numbers, notes = joint_numbers(
        [p.body for all_ in detections for p in all_]
    )

    px = np.full((len(files), ALL, 2), np.nan)
    conf = np.zeros((len(files), ALL))
    people = []
    for f, persons in enumerate(detections):
        people.append([_joints(person, numbers) for person in persons])
        if persons:
            px[f], conf[f] = people[f][0]
    several = max(map(len, people)) > 1
    return Detections(
        np.array(list(files)), px, conf, notes, people if several else None
    )


def _read_npz(path: Path) -> Detections:
    """Detections in an npz file, as `gsgan.prepare` writes MediaPipe's."""
    arrays = read_arrays(
        path, ("px", "conf", "left", "right", "face", "frame_id")
    )
    body = expect_array(arrays, "px", (None, BODY, 2), path).astype(np.float64)
    F = len(body)
    frame_id = whole_frame_ids(
        expect_array(arrays, "frame_id", (F,), path), str(path)
    )

    # The body.
    px = np.full((F, ALL, 2), np.nan)
    conf = np.zeros((F, ALL))
    px[:, :BODY] = body
    conf[:, :BODY] = expect_array(arrays, "conf", (F, BODY), path)

    # Hands and face, if the file has them; MediaPipe has no confidence for their landmarks.
    for name, part in (("left", LEFT), ("right", RIGHT)):
        if name in arrays:
            px[:, part] = expect_array(arrays, name, (F, HAND, 2), path)
            conf[:, part] = 1.0
    if "face" in arrays:
        mesh = expect_array(arrays, "face", (F, MESH_LANDMARKS, 2), path)
        px[:, FACE] = mesh[:, list(FACE_MESH.values())]
        conf[:, FACE] = 1.0
    return Detections(frame_id, px, conf)


class _Person(NamedTuple):
    """A person in a file: rows of x, y, confidence; a missing part has no rows."""

    body: Float  # [n, 3]
    left: Float  # [21, 3] hand
    right: Float  # [21, 3] hand


def _confidence(person: _Person) -> float:
    """The sum of a person's confidences."""
    return sum(float(part[:, 2].clip(0).sum()) for part in person)


def _read_people(path: Path) -> list[_Person]:
    """The people of a file of OpenPose or EasyMocap.

    Raises:
        DataError: if it is neither, or a person does not hold joints of a known set.
    """
    # Each program has a key of its own for the people.
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

    # The content may be anything: whatever is wrong with it is one error.
    try:
        return [
            _person(person, keys) for person in people if person is not None
        ]
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
    """The parts of one person, whose ``keys`` are those of its program."""
    if not isinstance(person, Mapping):
        raise TypeError(f"found {type(person).__name__}")

    # OpenPose of 2017 had names without _2d.
    if not {keys[0], keys[0].removesuffix("_2d")} & person.keys():
        raise KeyError(f"found {', '.join(person)}")
    parts = []
    for key in keys:
        # OpenPose writes triples flat, EasyMocap in rows.
        values = person.get(key) or person.get(key.removesuffix("_2d")) or []
        parts.append(np.array(values, np.float64).reshape(-1, 3))
    body, left, right = parts
    if len(body) and len(body) not in SETS:
        raise LookupError(len(body))
    return _Person(body, left, right)


def joint_numbers(
    bodies: Sequence[Float],
) -> tuple[dict[int, dict[int, int]], tuple[str, ...]]:
    """The numbers of MediaPipe's joints in bodies of each count of joints, and notes on doubts.

    Two sets have 25 joints. Joint 8 of BODY_25 is the middle of the hips, joints 9 and 12; of
    BODY_25B it is an elbow. Where no frame shows these joints and the neck, it is taken for
    BODY_25, with a note.

    Args:
        bodies: ``[n, 3]`` x, y, confidence of a person, in all frames.
    """
    numbers = {count: joints for count, (_, joints) in SETS.items()}

    # The distance of joint 8 from the middle of the hips, as a share of the trunk.
    distances = []
    of_25 = [body for body in bodies if len(body) == 25]
    for body in of_25:
        used = body[[1, 8, 9, 12]]
        neck, eighth, right, left = used[:, :2]
        if (used[:, 2] > 0).all():
            hips = (left + right) / 2
            trunk = max(float(np.linalg.norm(neck - hips)), 1e-6)
            distances.append(np.linalg.norm(eighth - hips) / trunk)
    if distances and np.median(distances) > MIDDLE_OF_HIPS:
        numbers[25] = BODY_25B
    notes = (UNTOLD,) if of_25 and not distances else ()
    return numbers, notes


def _joints(
    person: _Person,
    numbers: Mapping[int, Mapping[int, int]],
) -> tuple[Float, Float]:
    """Pixels ``[J, 2]`` and confidence ``[J]`` of a person; NaN and 0 = not seen."""
    px = np.full((ALL, 2), np.nan)
    conf = np.zeros(ALL)

    def put(joints: list[int], triples: Float) -> None:
        confidence = triples[:, 2]
        seen = is_known(triples) & (confidence > 0)
        px[joints] = np.where(
            seen[:, None], triples[:, :2] + PIXEL_CENTRE, np.nan
        )
        conf[joints] = np.where(seen, confidence, 0.0)

    # Joints of the body, then those of each whole hand.
    if len(person.body):
        joints = numbers[len(person.body)]
        put(list(joints), person.body[list(joints.values())])
    for hand, part in ((person.left, LEFT), (person.right, RIGHT)):
        if len(hand) == HAND:
            put(list(range(part.start, part.stop)), hand)

    # Joints of the body that only the hands have.
    for target, origin in FROM_HANDS.items():
        if conf[target] == 0:
            px[target] = px[origin]
            conf[target] = conf[origin]
    return px, conf
