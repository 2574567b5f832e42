"""A dataset on disk, validated and indexed, in the same form for every format.

A reader (`gsgan.data.formats`) finds the files and hands them to `assemble`, which checks every
format in the same way. Files are matched by camera name and by frame number, never by position:
one missing image must not shift the others.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from gsgan.data.cameras import CameraEntry
from gsgan.data.pixels import MaskFile, PixelRules
from gsgan.data.skeletons import Landmarks, Poses
from gsgan.data.validation import (
    Index,
    Thresholds,
    check_geometry,
    check_images,
    drop_frames,
    drop_unmasked,
    drop_unseen,
    frames_of,
)
from gsgan.utils.errors import DataError, explain
from gsgan.utils.frame_files import FrameFiles, entries, find_shifts

# Masks by camera and frame.
MaskIndex = Mapping[str, Mapping[int, tuple[MaskFile, ...]]]


@dataclass(frozen=True)
class BodyModel:
    """The skinned body that the poses move; plain values.

    Args:
        kind: "free" (ships with gsgan), "smpl" or "smplx".
        file: the user's model file, None for the free body.
        betas: shape of the subject; empty for the free body.
    """

    kind: str
    file: str | None = None
    betas: tuple[float, ...] = ()


@dataclass(frozen=True)
class Meta:
    """Facts about a capture as a whole.

    Args:
        unit: of the lengths in its files: m, cm or mm.
        fps: frames per second.
        up_axis: of the world, e.g. "z" or "-y".
        skeleton: name of the landmark set.
        skeleton_source: origin of the landmarks, e.g. "smpl24 -> mediapipe33".
        label_names: names of the part numbers, background first, or None.
        splits: train_cameras, test_cameras, train_frames, test_frames of the dataset itself,
            unchecked.
        layout: name of the format.
    """

    unit: str = "m"
    fps: float | None = None
    up_axis: str = "z"
    skeleton: str = "mediapipe33"
    skeleton_source: str = "mediapipe33"
    body: BodyModel | None = None
    label_names: tuple[str, ...] | None = None
    splits: Mapping[str, Any] = field(default_factory=dict)
    layout: str = "bring-your-own"


@dataclass(frozen=True, kw_only=True)
class _Contents:
    """The parts that `DatasetFiles` and `Layout` share. Paths are relative to the root.

    Args:
        root: the dataset's folder.
        meta: facts about the capture as a whole.
        cameras: by name, in the order of `camera_index`.
        images: by camera and frame.
        masks: by camera and frame, one or more per image, including those of images left out.
        labels: by camera and frame; empty without labels.
        landmarks: by frame.
        hands: 21 landmarks of the left hand and of the right one by frame, or None.
        face: `gsgan.skeleton.face.FACE_NAMES` by frame, or None.
        poses: by frame, or None.
        pixels: how to decode the files.
        notes: one sentence for each conversion or omission.
    """

    root: Path
    meta: Meta
    cameras: Mapping[str, CameraEntry]
    images: Mapping[str, FrameFiles]
    masks: MaskIndex
    labels: Index = field(default_factory=dict)
    landmarks: Landmarks
    hands: Landmarks | None = None
    face: Landmarks | None = None
    poses: Poses | None = None
    pixels: PixelRules = field(default_factory=PixelRules)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class DatasetFiles(_Contents):
    """The files that a reader found; they are not yet checked against each other.

    Args:
        mask_folder: where the masks of ``{camera}`` are expected, for messages.
        calibration: the file that holds the cameras, for messages.
        unit_hint: what to check when distances are implausible.
    """

    mask_folder: str = "mask/{camera}"
    calibration: Path
    unit_hint: str


@dataclass(frozen=True, kw_only=True)
class Layout(_Contents):
    """A capture on disk, validated and indexed; no image is decoded.

    Args:
        frames: usable frame numbers, rising.
    """

    frames: tuple[int, ...]

    @property
    def camera_names(self) -> tuple[str, ...]:
        """All cameras, in the order of `camera_index`."""
        return tuple(self.cameras)

    def image_path(self, camera: str, frame: int) -> Path:
        """The image of a camera and frame."""
        return self.root / self.images[camera][frame]

    def mask_path(self, camera: str, frame: int) -> Path:
        """The (first) mask of a camera and frame."""
        return self.root / self.masks[camera][frame][0].path

    def mask_files(self, camera: str, frame: int) -> list[tuple[str, Path]]:
        """All masks of a camera and frame with their rules, for `gsgan.data.pixels.read_mask`."""
        # Paths are stored relative to the root.
        files = []
        for mask in self.masks[camera][frame]:
            files.append((mask.rule, self.root / mask.path))
        return files

    def label_path(self, camera: str, frame: int) -> Path | None:
        """The part labels of a camera and frame, or None without labels."""
        # Single images may lack labels in a capture that has them.
        name = self.labels.get(camera, {}).get(frame)
        return None if name is None else self.root / name


def dataset_folder(root: str | Path, expected: str) -> Path:
    """The dataset's folder.

    Raises:
        DataError: when it does not exist, naming the ``expected`` content, or a link is to nothing.
    """
    # A wrong path is the most frequent mistake, so the message says what is expected.
    folder = Path(root).expanduser()
    if not folder.is_dir():
        problem = (
            "is a file, not a folder" if folder.exists() else "does not exist"
        )
        raise DataError(
            f"data.root={root} {problem}; expected the folder that holds {expected}"
        )
    # Names links to nothing.
    entries(folder)
    return folder


def assemble(contents: DatasetFiles, limits: Thresholds) -> Layout:
    """Checks the files against each other and leaves out those that cannot be used.

    Raises:
        DataError: for whatever is missing or contradictory, naming the file.
    """
    # Notes of the reader come before those of the checks.
    root = contents.root
    cameras = contents.cameras
    landmarks = contents.landmarks
    calibration = contents.calibration
    masks = {frame for files in contents.masks.values() for frame in files}
    others = {"masks": masks, "landmarks": landmarks.p}
    shifted = find_shifts(frames_of(contents.images), others)
    if not shifted:
        for name, files in contents.images.items():
            mask_files = {"masks": contents.masks.get(name, {})}
            shifted += find_shifts(files, mask_files, f"images of {name}")
    notes = [*contents.notes, *shifted]
    cause = None
    if shifted:
        cause = f"{root}: {shifted[0].removeprefix('doubtful: ')}"

    # Frames need a skeleton, and cameras must fit the skeletons.
    with explain(cause):
        images = drop_frames(
            root, contents.images, landmarks, contents.poses, limits, notes
        )
    check_geometry(
        root,
        cameras,
        images,
        landmarks,
        limits,
        calibration,
        contents.unit_hint,
    )

    # Images must show the person and have a mask.
    images = drop_unseen(cameras, images, landmarks, limits, calibration, notes)
    folders = {}
    for name in cameras:
        folders[name] = root / contents.mask_folder.format(camera=name)
    with explain(cause):
        images = drop_unmasked(images, contents.masks, folders, limits, notes)

    # Labels of the images that are left; none at all is the same as a capture without labels.
    labels = {}
    for name, files in images.items():
        stored = contents.labels.get(name, {})
        labels[name] = {f: path for f, path in stored.items() if f in files}
    if not any(labels.values()):
        labels = {}

    # Headers are read last: this takes longest.
    check_images(
        root,
        cameras,
        images,
        contents.masks,
        labels,
        stride=limits.header_stride,
        calibration=calibration,
    )

    # All other fields stay as the reader found them.
    kept = {one.name: getattr(contents, one.name) for one in fields(_Contents)}
    kept |= {"images": images, "labels": labels, "notes": tuple(notes)}
    return Layout(**kept, frames=tuple(frames_of(images)))
