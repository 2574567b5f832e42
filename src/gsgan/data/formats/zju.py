"""Reader of ZJU-MoCap.

::

    original   annots.npy  Camera_B1/000000.jpg  mask/ mask_cihp/  new_params/ or params/
    refined    annots.npy  images/00/000000.jpg  mask/00/          smpl_params/

Subjects 313 and 315 of the original release have 21 cameras (``Camera (1)``, no 20 and 21), long
file names, frames that count from 1 and nested lists in annots.npy.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gsgan.body.smpl import SkinnedModel
from gsgan.body.smpl_names import CIHP
from gsgan.data.cameras import CameraEntry, make_camera
from gsgan.data.formats.common import (
    IMAGES,
    FolderReader,
    body_model,
    image_size,
    up_axis,
)
from gsgan.data.formats.smpl_motion import SmplMotion, landmarks_of, zju_motion
from gsgan.data.layout import BodyModel, DatasetFiles, Meta
from gsgan.data.pixels import IGNORE_LABEL, MaskFile, PixelRules, mask_file
from gsgan.data.skeletons import make_landmarks
from gsgan.data.validation import Thresholds, frames_of
from gsgan.utils.errors import DataError
from gsgan.utils.frame_files import (
    FrameFiles,
    frame_files,
    frame_of,
    last_number,
)
from gsgan.utils.pickles import read_npy

Files = Mapping[str, Mapping[int, str]]
"""Paths relative to the root, by camera and frame."""

ANNOTS = ("annots.npy", "annots_new.npy")
MILLIMETRES = 1e-3
# Plausible lengths of the cameras' T, metres.
TRANSLATION = (0.05, 20.0)
# as in CoreView_313_Camera_(1)_0001_2019-08-23_16-08-50.592
NAMED_FRAME = re.compile(r"\)_(\d+)")
# part numbers by stored label: files may hold stray numbers beyond CIHP's
CIHP_TABLE = tuple(i if i < len(CIHP) else IGNORE_LABEL for i in range(256))
# Folders of SMPL parameters, the best fit first.
FITS = {"refit": "new_params", "refined": "smpl_params", "first": "params"}
# the fit whose body is posed without pose blend shapes
UNBLENDED = "first"


@dataclass(frozen=True, kw_only=True)
class ZjuReader(FolderReader):
    """Reads a ZJU-MoCap subject; conf/data/zju_mocap.yaml explains the settings."""

    ignore_band: int = 5
    max_missing_masks: float = 0.5

    contents: ClassVar[str] = (
        "a ZJU-MoCap subject (annots.npy and camera folders)"
    )
    hint: ClassVar[str] = (
        "check that cameras, SMPL parameters and masks come from one release (the refined my_* "
        "ones do not fit CoreView images)"
    )

    def find(
        self, root: Path, limits: Thresholds, smpl: str | None
    ) -> DatasetFiles:
        """See `FolderReader.find`."""
        # Cameras, and the images in their folders.
        annots = read_annots(root)
        file, model = body_model(root, smpl, "smpl")
        notes = ["lengths of the cameras converted from mm to metres"]
        folders = camera_folders(root, annots)
        images = _index_images(root, folders)
        cameras = self._cameras(root, annots, images)

        # The SMPL fit that the release has, the best first.
        kinds = [
            kind for kind, folder in FITS.items() if (root / folder).is_dir()
        ]
        if not kinds:
            looked = "/, ".join(FITS.values())
            raise DataError(
                f"{root} has no SMPL parameters; expected one of the folders {looked}/"
            )
        kind = kinds[0]
        params = FITS[kind]

        # Poses of the frames that have images, and the landmarks on the posed body.
        motion = _read_motion(root, params, frames_of(images), model)
        p, conf = landmarks_of(model, motion, pose_blend=kind != UNBLENDED)

        # Part labels count as masks too.
        masks, labels = _index_masks(root, folders)
        return DatasetFiles(
            root=root,
            meta=Meta(
                unit="mm",
                up_axis=up_axis(cameras.values()),
                skeleton_source="smpl24 -> mediapipe33",
                body=BodyModel(
                    "smpl", str(file), tuple(motion.betas[0].tolist())
                ),
                label_names=CIHP if labels else None,
                layout="ZJU-MoCap",
            ),
            cameras=cameras,
            images=images,
            masks=masks,
            labels=labels,
            landmarks=make_landmarks(
                motion.ids, p, conf, limits.max_reach, notes, f"{params}/"
            ),
            poses=motion.poses(f"{params}/"),
            pixels=PixelRules(
                mask_sampling="nearest",
                label_table=CIHP_TABLE,
                ignore_band=self.ignore_band,
            ),
            calibration=annots.path,
            unit_hint=f"T in {annots.path} must be in millimetres, Th in {root / params} in metres",
            notes=tuple(notes),
        )

    def _cameras(
        self, root: Path, annots: Annots, images: Files
    ) -> dict[str, CameraEntry]:
        """The cameras by name, in the order of annots.npy."""
        # A camera without images takes the size of another one.
        some = next(files for files in images.values() if files)
        cameras = {}
        for i, (name, files) in enumerate(images.items()):
            cameras[name] = make_camera(
                f"{annots.path}, camera {name} (index {i})",
                name,
                K=annots.K[i],
                R=annots.R[i],
                t=annots.T[i],
                dist=annots.D[i],
                size=image_size(root, files or some),
                scale=MILLIMETRES,
                pixel_centre=self.pixel_centre,
            )

        # Implausible lengths of T mean another unit than millimetres.
        lengths = [np.linalg.norm(camera.t) for camera in cameras.values()]
        length = float(np.median(lengths))
        low, high = TRANSLATION
        if not low <= length <= high:
            raise DataError(
                f"{annots.path}: T is {length:.3g} m long (median, taken as millimetres), expected "
                f"{low:g}-{high:g} m; this file's T is not in millimetres"
            )
        return cameras


class Annots(NamedTuple):
    """annots.npy: its path, and one K, R, T, D and image folder (as listed) per camera."""

    path: Path
    K: Sequence[Any]
    R: Sequence[Any]
    T: Sequence[Any]
    D: Sequence[Any]
    folders: Sequence[str]


def read_annots(root: Path) -> Annots:
    """The content of the first of `ANNOTS` that exists; that of some copies lists no images.

    Raises:
        DataError: when there is none, it is damaged, or its cameras are not complete.
    """
    # The file that every release has, under one of two names.
    path = next(
        (root / name for name in ANNOTS if (root / name).exists()), None
    )
    if path is None:
        raise DataError(
            f"{root} is not a ZJU-MoCap subject: it has no annots.npy (copies that other projects "
            "prepared are not supported)"
        )

    # A pickled dict: the cameras, and the images of each frame.
    content = read_npy(path)
    cams = content.get("cams") if isinstance(content, dict) else None
    if not isinstance(cams, dict):
        raise DataError(
            f"{path} has no 'cams'; expected a dict with cams and ims"
        )

    # The cameras' folders are those of the first frame's images; some copies list no images.
    folders = []
    frames = _entries(content.get("ims"))
    if not frames:
        for place in sorted(root.glob("images/*")):
            if place.is_dir():
                folders.append(f"images/{place.name}")
    elif isinstance(frames[0], Mapping):
        for name in _entries(frames[0].get("ims")):
            image = PurePosixPath(str(name).replace("\\", "/"))
            folders.append(str(image.parent))

    # Every list has one entry per camera.
    annots = Annots(
        path=path,
        K=_entries(cams.get("K")),
        R=_entries(cams.get("R")),
        T=_entries(cams.get("T")),
        D=_entries(cams.get("D")),
        folders=folders,
    )
    counts = {key: len(getattr(annots, key)) for key in "KRTD"}
    counts["image folders"] = len(folders)
    if len(set(counts.values())) != 1 or not folders:
        listing = ", ".join(f"{count} {key}" for key, count in counts.items())
        raise DataError(
            f"{path} must hold one K, R, T, D and image folder per camera, found {listing}"
        )
    return annots


def _entries(value: Any) -> list[Any]:
    """The entries of a list or array, none for anything else."""
    # Releases differ: arrays, or nested lists.
    array = isinstance(value, np.ndarray) and value.ndim > 0
    return list(value) if array or isinstance(value, (list, tuple)) else []


def camera_folders(root: Path, annots: Annots) -> dict[str, str]:
    """Image folder by camera name (the folder's own), in the order of annots.npy.

    Raises:
        DataError: when a folder is not one of the subject's, or two cameras share one.
    """
    # Copies move the folders, so each is looked for.
    places = [_place(root, folder) for folder in annots.folders]

    # Masks are found by the folder's name, so it must be unique.
    named = {PurePosixPath(place).name: place for place in places}
    if len(named) != len(places):
        raise DataError(
            f"{annots.path}: two cameras share an image folder: {', '.join(places)}"
        )
    return named


def _place(root: Path, folder: str) -> str:
    """The path of a folder that annots.npy names, relative to the root; copies are often
    rearranged."""
    # A path from a file must not lead out of the dataset.
    parts = PurePosixPath(folder).parts
    if not parts or ".." in parts or PurePosixPath(folder).is_absolute():
        raise DataError(
            f"{root}: annots lists images in {folder!r}, which is not a folder in it"
        )

    # As listed, at the top, or in a folder of images.
    for place in (folder, parts[-1], f"images/{parts[-1]}"):
        if (root / place).is_dir():
            return place
    return folder


def frame_number(stem: str) -> int | None:
    """The frame number in an image's name, 313's and 315's long names included."""
    # The last number of a long name is a time.
    named = NAMED_FRAME.search(stem)
    return frame_of(named[1]) if named else last_number(stem)


def _index_images(
    root: Path, folders: Mapping[str, str]
) -> dict[str, FrameFiles]:
    """The images of each camera by frame number."""
    # A single camera may have none, but not all of them.
    images = {}
    for name, folder in folders.items():
        images[name] = frame_files(root, folder, IMAGES, frame_number)
    if not any(images.values()):
        raise DataError(
            f"{root}: no camera folder holds images; expected e.g. "
            f"{next(iter(folders.values()))}/000000.jpg"
        )
    return images


def _index_masks(
    root: Path, folders: Mapping[str, str]
) -> tuple[dict[str, dict[int, tuple[MaskFile, ...]]], Files]:
    """Masks and part labels by camera and frame."""
    masks: dict[str, dict[int, tuple[MaskFile, ...]]] = {}
    labels: dict[str, dict[int, str]] = {}

    # CIHP's part labels, which JPEG compression would damage; as masks, every part is the person.
    for name, folder in folders.items():
        # Part labels, whose pixels above 0 are the person.
        parts = _mask_files(root, "mask_cihp", name, folder)
        masks[name] = {}
        labels[name] = {}
        for frame, path in parts.items():
            masks[name][frame] = (MaskFile("nonzero", path),)
            if path.endswith(".png"):
                labels[name][frame] = path

    # The other masks of the same images are joined with them.
    for name, folder in folders.items():
        by_frame = masks[name]
        for frame, path in _mask_files(root, "mask", name, folder).items():
            by_frame[frame] = (*by_frame.get(frame, ()), mask_file(path))
    return masks, labels if any(labels.values()) else {}


def _mask_files(
    root: Path,
    kind: str,
    name: str,
    folder: str,
) -> FrameFiles:
    """A camera's masks of one kind: in mask/Camera_B1, or mask/images/00 as some copies have it."""
    place = f"{kind}/{name}"
    other = f"{kind}/{folder}"
    if not (root / place).is_dir() and (root / other).is_dir():
        place = other
    return frame_files(root, place, (".png", ".jpg"), frame_number)


def _read_motion(
    root: Path,
    folder: str,
    frames: Iterable[int],
    model: SkinnedModel,
) -> SmplMotion:
    """The parameters of the frames that have any, in the model's own convention."""
    # One file per frame, named by its number.
    files = frame_files(root, folder, (".npy",))
    ids = sorted(set(frames) & set(files))
    if not ids:
        some = ", ".join(list(files.values())[:3])
        raise DataError(
            f"{root / folder} has no parameters of any frame that has images; it holds "
            f"{len(files)} files ({some or 'none'})"
        )

    # By frame: the file's name for messages, and its content.
    entries = {}
    for frame in ids:
        path = root / files[frame]
        entries[frame] = (str(path), read_npy(path))
    return zju_motion(entries, model)
