"""2D landmarks from the files of MediaPipe, OpenPose and EasyMocap."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsgan.data.files import read_arrays, read_json
from gsgan.data.joints import ALL, BODY, FACE, FACE_MESH, FROM_HANDS, LEFT, RIGHT, SETS, known
from gsgan.data.skeletons import whole_frame_ids
from gsgan.motion.points import Numbered, json_files
from gsgan.skeleton.hands import HAND
from gsgan.utils.arrays import Float, Ints, expect_array
from gsgan.utils.errors import DataError

MESH = 468  # landmarks of MediaPipe's face mesh
PIXEL_CENTRE = 0.5  # added to detectors that count from the centre of the first pixel
OPENPOSE_KEYS = ("pose_keypoints_2d", "hand_left_keypoints_2d", "hand_right_keypoints_2d")
EASYMOCAP_KEYS = ("keypoints", "handl2d", "handr2d")


@dataclass(frozen=True)
class Detections:
    """One camera's detections of the J joints: 33 body, 21 left hand, 21 right hand, 30 face."""

    frame_id: Ints  # [F] rising
    px: Float  # [F, J, 2] pixels of the image as stored, pixel centres at +0.5; NaN = not seen
    conf: Float  # [F, J] in [0, 1], 0 = not seen


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
        files = json_files(path)
        px, conf = map(np.array, zip(*map(_read_frame, files.values()), strict=True))
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


def _read_frame(path: Path) -> tuple[Float, Float]:
    content = read_json(path)
    if isinstance(content.get("people"), list):
        keys, people = OPENPOSE_KEYS, content["people"]
    elif isinstance(content.get("annots"), list):
        keys, people = EASYMOCAP_KEYS, content["annots"]
    else:
        raise DataError(f"{path} has neither 'people' (OpenPose) nor 'annots' (EasyMocap)")
    people = [person for person in people if person is not None]  # nobody
    try:
        read = [_person(person, keys) for person in people]
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        sets = ", ".join(f"{n} ({name})" for n, (name, _) in SETS.items())
        raise DataError(
            f"{path}: a person must hold '{keys[0]}' with x, y, confidence of {sets} joints "
            f"({error})"
        ) from None
    if not read:
        return np.full((ALL, 2), np.nan), np.zeros(ALL)
    return max(read, key=lambda one: float(one[1].sum()))  # the person seen best


def _person(person: Mapping[str, Any], keys: tuple[str, ...]) -> tuple[Float, Float]:
    px, conf = np.full((ALL, 2), np.nan), np.zeros(ALL)

    def put(joints: list[int], triples: Float) -> None:
        seen = known(triples) & (triples[:, 2] > 0)
        px[joints] = np.where(seen[:, None], triples[:, :2] + PIXEL_CENTRE, np.nan)
        conf[joints] = np.where(seen, triples[:, 2], 0.0)

    # OpenPose writes triples flat, EasyMocap in rows; OpenPose of 2017 had names without _2d.
    if not {keys[0], keys[0].removesuffix("_2d")} & person.keys():
        raise KeyError(f"found {', '.join(person)}")
    found = [person.get(key) or person.get(key.removesuffix("_2d")) or [] for key in keys]
    body, *hands = (np.array(values, np.float64).reshape(-1, 3) for values in found)
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
