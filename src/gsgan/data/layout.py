"""A dataset on disk, validated and indexed, whatever its format: what `CaptureDataset` reads from.

A reader (`gsgan.data.formats`) finds what lies where and hands it to `assemble`, which checks it
in the same way for every format. Everything is joined by camera name and by frame number, never by
position: one dropped picture must not shift the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsgan.data.cameras import CameraEntry
from gsgan.data.checks import (
    Checks,
    Index,
    check_geometry,
    check_pictures,
    drop_frames,
    drop_unmasked,
    drop_unseen,
    spans,
)
from gsgan.data.pixels import IGNORE_LABEL, MaskFile, PixelRules
from gsgan.data.skeletons import Landmarks, Poses, fill_missing
from gsgan.utils.errors import DataError

__all__ = [
    "IGNORE_LABEL",
    "BodyModel",
    "CameraEntry",
    "Checks",
    "Found",
    "Landmarks",
    "Layout",
    "Meta",
    "Poses",
    "assemble",
    "dataset_folder",
    "fill_missing",
    "spans",
]

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
    """What is known of a capture as a whole.

    Args:
        unit: of the lengths in its files: m, cm or mm.
        fps: frames a second, or None when it is not said.
        up_axis: of the world, e.g. "z" or "-y".
        skeleton: name of the landmark set.
        skeleton_source: where the landmarks come from, e.g. "smpl24 -> mediapipe33".
        body: the skinned body that the poses move, or None.
        label_names: names of the part numbers, background first, or None.
        labels_named_by: who gives those names, for messages.
        splits: train_cameras, test_cameras, train_frames, test_frames as the data has them,
            unchecked.
        layout: which format this is, in words.
    """

    unit: str = "m"
    fps: float | None = None
    up_axis: str = "z"
    skeleton: str = "mediapipe33"
    skeleton_source: str = "mediapipe33"
    body: BodyModel | None = None
    label_names: tuple[str, ...] | None = None
    labels_named_by: str = "meta.json"
    splits: Mapping[str, Any] = field(default_factory=dict)
    layout: str = "bring-your-own"


@dataclass(frozen=True)
class Found:
    """What a reader found, each part checked by itself but not yet against the others.

    Args:
        root: the dataset's folder; all paths are relative to it.
        meta: about the whole.
        cameras: by name, in the order that `camera_index` counts.
        images: by camera and frame.
        masks: by camera and frame, one or more a picture; pictures may lack theirs.
        mask_folders: where a camera's masks should be, for messages.
        labels: by camera and frame; empty when there are none.
        landmarks: by frame.
        poses: by frame, or None.
        pixels: how the files are to be understood.
        calibration: the file that holds the cameras, for messages.
        unit_hint: what to look at when distances are not believable.
        notes: one sentence for each thing converted or left out so far.
    """

    root: Path
    meta: Meta
    cameras: Mapping[str, CameraEntry]
    images: Index
    masks: MaskIndex
    mask_folders: Mapping[str, Path]
    labels: Index
    landmarks: Landmarks
    poses: Poses | None
    pixels: PixelRules
    calibration: Path
    unit_hint: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Layout:
    """A capture on disk, validated and indexed; no picture is decoded.

    Args:
        root: the folder.
        meta: about the whole.
        cameras: by name; `camera_index` counts in this order.
        frames: usable frame numbers, rising.
        images: paths relative to the root by camera and frame, usable ones only.
        masks: the same for masks, one or more a picture.
        labels: the same for part labels; empty when the capture has none.
        landmarks: by frame.
        poses: by frame, or None.
        pixels: how the files are to be understood.
        notes: one sentence for each thing converted, dropped or left out.
    """

    root: Path
    meta: Meta
    cameras: Mapping[str, CameraEntry]
    frames: tuple[int, ...]
    images: Index
    masks: MaskIndex
    labels: Index
    landmarks: Landmarks
    poses: Poses | None
    pixels: PixelRules
    notes: tuple[str, ...]

    @classmethod
    def read(cls, root: str | Path, checks: Checks | None = None) -> Layout:
        """Reads a folder in the bring-your-own layout, see `gsgan.data.formats.capture`."""
        from gsgan.data.formats.capture import read_capture

        return read_capture(root, checks)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """All cameras, in the order that `camera_index` counts."""
        return tuple(self.cameras)

    def image_path(self, camera: str, frame: int) -> Path:
        """The picture of a camera and frame."""
        return self.root / self.images[camera][frame]

    def mask_path(self, camera: str, frame: int) -> Path:
        """The (first) mask of a camera and frame."""
        return self.root / self.masks[camera][frame][0].path

    def mask_files(self, camera: str, frame: int) -> list[tuple[str, Path]]:
        """All masks of a camera and frame with their rules, for `gsgan.data.pixels.read_mask`."""
        return [(mask.rule, self.root / mask.path) for mask in self.masks[camera][frame]]

    def label_path(self, camera: str, frame: int) -> Path | None:
        """The part labels of a camera and frame, or None when it has none."""
        name = self.labels.get(camera, {}).get(frame)
        return None if name is None else self.root / name


def dataset_folder(root: str | Path, expected: str) -> Path:
    """The dataset's folder.

    Raises:
        DataError: when it is not there, saying what was expected in it.
    """
    folder = Path(root).expanduser()
    if not folder.is_dir():
        what = "is a file, not a folder" if folder.exists() else "does not exist"
        raise DataError(f"data.root={root} {what}; expected the folder that holds {expected}")
    return folder


def assemble(found: Found, checks: Checks) -> Layout:
    """Checks what was found against itself and leaves out what cannot be used.

    Raises:
        DataError: for whatever is missing or contradictory, naming the file.
    """
    root, cameras, notes = found.root, found.cameras, list(found.notes)
    images = drop_frames(root, found.images, found.landmarks, found.poses, checks, notes)
    check_geometry(
        root, cameras, images, found.landmarks, checks, found.calibration, found.unit_hint
    )
    images = drop_unseen(cameras, images, found.landmarks, checks, found.calibration, notes)
    images = drop_unmasked(images, found.masks, found.mask_folders, checks, notes)
    masks = {c: {f: found.masks[c][f] for f in files} for c, files in images.items()}
    labels = _labels_of(images, found.labels, notes)
    check_pictures(root, cameras, images, masks, labels, checks.header_stride, found.calibration)
    return Layout(
        root=root,
        meta=found.meta,
        cameras=cameras,
        frames=tuple(sorted({f for files in images.values() for f in files})),
        images=images,
        masks=masks,
        labels=labels,
        landmarks=found.landmarks,
        poses=found.poses,
        pixels=found.pixels,
        notes=tuple(notes),
    )


def _labels_of(images: Index, found: Index, notes: list[str]) -> Index:
    labels = {c: {f: p for f, p in found.get(c, {}).items() if f in images[c]} for c in images}
    pictures = sum(len(files) for files in images.values())
    lacking = pictures - sum(len(files) for files in labels.values())
    if 0 < lacking < pictures:
        notes.append(f"{lacking} of {pictures} pictures have no labels, they count as 'ignore'")
    return labels if lacking < pictures else {}
