"""Reader of EasyMocap's folders.

::

    intri.yml  extri.yml         OpenCV YAML, metres, paired by camera name
    images/{camera}/%06d.jpg     mask/{camera}/%06d.png or %06d_{person}.png
    keypoints3d/%06d.json        BODY_25, with hands, with face: also output/keypoints3d
    smpl/%06d.json               SMPL fits: also output/smpl
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from gsgan.data.calibration import read_calibration
from gsgan.data.cameras import CameraEntry
from gsgan.data.formats.common import (
    IMAGES,
    FolderReader,
    body_model,
    image_size,
    up_axis,
)
from gsgan.data.formats.smpl_motion import landmarks_of, zju_motion
from gsgan.data.layout import BodyModel, DatasetFiles, Meta
from gsgan.data.pixels import MaskFile, mask_file
from gsgan.data.skeletons import make_landmarks
from gsgan.data.validation import Thresholds, frames_of, spans
from gsgan.skeleton.hands import HAND
from gsgan.skeleton.joints import BODY, FROM_HANDS, SETS
from gsgan.utils.arrays import Float, Ints, as_floats
from gsgan.utils.errors import DataError
from gsgan.utils.files import read_json_value
from gsgan.utils.frame_files import frame_files, natural_order

SKELETON_SOURCES = {
    "smpl": "smpl24 -> mediapipe33",
    "keypoints3d": "body25 -> mediapipe33",
}
# Folders of EasyMocap's results, which depend on its version.
RESULTS = ("{kind}", "output/{kind}", "output-{kind}/{kind}")
# Bound on the person's number in a mask's name.
PEOPLE = 1000
# keys of the list of people
PEOPLE_KEYS = ("annots", "people")

BODY_25 = 25
BODY_AND_HANDS = BODY_25 + 2 * HAND
# the body; with hands, left first; with hands and face
JOINT_COUNTS = (BODY_25, BODY_AND_HANDS, BODY_AND_HANDS + 51)
# Numbers of joints in the file by MediaPipe's.
BODY_25_TO_33 = SETS[BODY_25][1]
HANDS_TO_33 = {
    landmark: BODY_25 + joint - BODY for landmark, joint in FROM_HANDS.items()
}


@dataclass(frozen=True, kw_only=True)
class EasymocapReader(FolderReader):
    """Reads a folder of EasyMocap; conf/data/easymocap.yaml explains the settings."""

    person: int = 0
    distance: tuple[float, float] = (0.3, 30.0)
    fps: float | None = None

    contents: ClassVar[str] = (
        "intri.yml, extri.yml, images/, mask/, and keypoints3d/ or smpl/"
    )
    hint: ClassVar[str] = (
        "check that calibration, skeleton and masks are of one recording and one person "
        "(data.reader.person)"
    )

    def find(
        self, root: Path, limits: Thresholds, smpl: str | None
    ) -> DatasetFiles:
        """See `FolderReader.find`."""
        # Images of the cameras that have a folder, and their calibrations.
        notes: list[str] = []
        names = _camera_folders(root, self.contents)
        images = {
            name: frame_files(root, f"images/{name}", IMAGES) for name in names
        }
        for name, files in images.items():
            if not files:
                raise DataError(
                    f"{root / 'images' / name} holds no images; expected 000000.jpg"
                )
        cameras = self._cameras(root, images, notes)

        # The person's SMPL fits, if the user has the model, else the keypoints.
        kind, place = _source(root, smpl)
        people = _read_people(
            root, place, frames_of(images), self.person, notes
        )

        # Landmarks on the fitted body, or the keypoints themselves.
        motion = None
        body = None
        if kind == "smpl":
            # SMPL's joints need the user's model.
            file, model = body_model(root / place, smpl, "smpl")
            motion = zju_motion(people, model)
            body = BodyModel("smpl", str(file), tuple(motion.betas[0].tolist()))
            ids = motion.ids
            p, conf = landmarks_of(model, motion)
        else:
            ids, p, conf = _read_keypoints(people)

        # Everything in the reader's terms; the layout has no part labels.
        return DatasetFiles(
            root=root,
            meta=Meta(
                fps=self.fps,
                up_axis=up_axis(cameras.values()),
                skeleton_source=SKELETON_SOURCES[kind],
                body=body,
                layout="EasyMocap",
            ),
            cameras=cameras,
            images=images,
            masks=_masks(root, names, self.person),
            mask_folder="mask/{camera}",
            landmarks=make_landmarks(
                ids, p, conf, limits.max_reach, notes, source=f"{place}/"
            ),
            poses=None if motion is None else motion.poses(f"{place}/"),
            calibration=root / "intri.yml and extri.yml",
            unit_hint=f"T in {root / 'extri.yml'} and {root / place} must be in metres",
            notes=tuple(notes),
        )

    def _cameras(
        self,
        root: Path,
        images: Mapping[str, Mapping[int, str]],
        notes: list[str],
    ) -> dict[str, CameraEntry]:
        """The cameras that have images, by name, in natural order."""
        # Every folder of images needs a camera of the same name.
        path = root / "intri.yml"
        calibration = read_calibration(path, pixel_centre=self.pixel_centre)
        notes += calibration.notes
        calibrated = calibration.cameras

        # The size of the images is not in the calibration.
        cameras = {}
        for name, files in images.items():
            if name not in calibrated:
                raise DataError(
                    f"{root / 'images' / name} is not a camera of {path}, which lists "
                    f"{', '.join(calibrated)}; cameras are paired by name: rename the folder or "
                    "calibrate it"
                )
            # A calibration without sizes takes those of the images.
            camera = calibrated[name]
            if min(camera.size) == 0:
                camera = replace(camera, size=image_size(root, files))
            cameras[name] = camera

        # Cameras of the calibration that did not record this take.
        idle = [name for name in calibrated if name not in images]
        if idle:
            notes.append(
                f"{path} lists cameras without images, left out: {', '.join(idle)}"
            )
        return cameras


def _source(root: Path, smpl: str | None) -> tuple[str, str]:
    """The kind of skeletons to use, fits if the user has the model, and their folder."""
    # Folders that exist, fits first.
    places = []
    for kind in SKELETON_SOURCES:
        for pattern in RESULTS:
            place = pattern.format(kind=kind)
            if (root / place).is_dir():
                places.append((kind, place))
    if not places:
        raise DataError(
            f"{root} has no skeletons; expected keypoints3d/ or smpl/ in it, or in output/: run "
            "EasyMocap's reconstruction first"
        )

    # Fits need the model. If there is nothing else, reading them reports that it is missing.
    for kind, place in places:
        if kind != "smpl" or smpl is not None:
            return kind, place
    return places[0]


def _masks(
    root: Path, names: Sequence[str], person: int
) -> dict[str, dict[int, tuple[MaskFile, ...]]]:
    """The masks by camera and frame; only those of the person if their names hold an id."""
    masks = {}
    for name in names:
        # Keys hold the frame and the person.
        files = frame_files(
            root, f"mask/{name}", (".png", ".jpg"), _frame_and_person
        )
        by_frame: dict[int, tuple[MaskFile, ...]] = {}
        # A mask without an id comes first, so that the person's own replaces it.
        for key, path in sorted(files.items()):
            frame, number = divmod(key, PEOPLE)
            if number in (0, person + 1):
                by_frame[frame] = (mask_file(path),)
        masks[name] = by_frame
    return masks


def _camera_folders(root: Path, contents: str) -> list[str]:
    """Names of the cameras that have a folder of images, in natural order."""
    # Without calibration the images are of no use.
    for name in ("intri.yml", "extri.yml"):
        if not (root / name).is_file():
            raise DataError(
                f"{root / name} does not exist; a folder of EasyMocap holds {contents}"
            )

    # Hidden folders do not count.
    place = root / "images"
    names = []
    for path in place.glob("*"):
        if path.is_dir() and not path.name.startswith("."):
            names.append(path.name)
    if not names:
        raise DataError(
            f"{place} holds no folder of a camera; a folder of EasyMocap holds {contents}: extract "
            "the frames of videos/"
        )
    return sorted(names, key=natural_order)


def _frame_and_person(stem: str) -> int | None:
    """One number for frame and person: "000012_1" is frame 12 of person 1, "000012" has no id."""
    # The frame, and optionally the person.
    match = re.fullmatch(r"(\d+)(?:_(\d{1,2}))?", stem)
    if match is None:
        return None
    frame = int(match[1])
    person = int(match[2]) + 1 if match[2] else 0
    return frame * PEOPLE + person


def _read_people(
    root: Path,
    folder: str,
    frames: Collection[int],
    person: int,
    notes: list[str],
) -> dict[int, tuple[str, Mapping[str, Any]]]:
    """The person's entry, with the file's name for messages, by frame that has images."""
    # One file per frame, each with all people.
    files = frame_files(root, folder, (".json",))
    entries = {}
    lacking = []
    seen = set[int]()
    there = sorted(set(frames) & set(files))

    # Frames without the person are left out later, with a note.
    for frame in there:
        people = _people(root / files[frame])
        seen |= set(people)
        if person in people:
            entries[frame] = (
                f"{root / files[frame]}, person {person}",
                people[person],
            )
        else:
            lacking.append(frame)

    # The most likely cause is another number of the person.
    if not entries:
        ids = ", ".join(map(str, sorted(seen))) or "nobody"
        raise DataError(
            f"{root / folder} has no person {person} in the {len(there)} of its {len(files)} files "
            f"that belong to images (found: {ids}); set data.reader.person"
        )
    if lacking:
        notes.append(
            f"{folder} lacks person {person} at frames {spans(lacking)}"
        )
    return entries


def _people(path: Path) -> dict[int, Mapping[str, Any]]:
    """All people in a file by id."""
    content = read_json_value(path)
    # Some versions wrap the list in an object.
    if isinstance(content, Mapping):
        content = next(
            (content[key] for key in PEOPLE_KEYS if key in content), None
        )
    entries = content if isinstance(content, list) else [None]
    people: dict[int, Mapping[str, Any]] = {}
    for entry in entries:
        if not isinstance(entry, Mapping):
            raise DataError(
                f"{path} must hold a list of people, each an object with 'id'"
            )

        # Ids tell people apart from frame to frame.
        number = entry.get("id")
        if type(number) is not int or number in people:
            raise DataError(
                f"{path}: each person needs a whole 'id' that no other has, found {number}"
            )
        people[number] = entry
    return people


def _read_keypoints(
    people: Mapping[int, tuple[str, Mapping[str, Any]]],
) -> tuple[Ints, Float, Float]:
    """MediaPipe's 33 landmarks from BODY_25, with hands if the file has them.

    Joints that BODY_25 lacks (corners of the eyes, mouth; without hands also fingers)
    and joints that were not seen, for which EasyMocap writes zeros, are NaN with confidence 0.

    Returns:
        ``ids [F]`` rising, ``p [F, 33, 3]`` metres and ``conf [F, 33]``.
    """
    # Joints are unknown until a file has them.
    p = np.full((len(people), BODY, 3), np.nan)
    conf = np.zeros((len(people), BODY))
    for row, (where, entry) in enumerate(people.values()):
        # The numbers of the joints in the file, by landmark.
        joints = _joints(where, entry.get("keypoints3d"))
        table = BODY_25_TO_33
        if len(joints) > BODY_25:
            table = BODY_25_TO_33 | HANDS_TO_33

        # Only joints that were seen.
        taken = joints[list(table.values())]
        seen = np.isfinite(taken).all(axis=1) & (taken[:, 3] > 0)
        landmarks = np.array(list(table))[seen]
        p[row, landmarks] = taken[seen, :3]
        conf[row, landmarks] = taken[seen, 3]
    return np.array(list(people), np.int64), p, conf


def _joints(where: str, raw: Any) -> Float:
    """``[J, 4]`` x, y, z and confidence, which is 1 if the file has none."""
    # Ragged lists, and other objects, give an array without numbers.
    joints = as_floats(raw)
    fits = joints.ndim == 2 and joints.shape[1] in (3, 4)
    if not fits or len(joints) not in JOINT_COUNTS:
        counts = ", ".join(map(str, JOINT_COUNTS))
        raise DataError(
            f"{where}: 'keypoints3d' must have shape (J, 4) with J one of {counts} (BODY_25, with "
            f"hands, with face), found {joints.shape if joints.size else type(raw).__name__}"
        )

    # Some versions write no confidence.
    if joints.shape[1] == 3:
        joints = np.concatenate([joints, np.ones((len(joints), 1))], axis=1)
    return joints
