"""The files of ZJU-MoCap's releases: cameras in ``annots.npy`` (millimetres), and SMPL fits."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.body.smpl import SkinnedModel
from gsgan.data.cameras import CameraEntry, make_camera
from gsgan.data.files import frame_files, frame_of, last_number, natural_order
from gsgan.data.formats.common import IMAGES, picture_size
from gsgan.data.formats.smpl_motion import Motion, posed, zju_motion
from gsgan.utils.errors import DataError
from gsgan.utils.pickles import read_npy

Float = NDArray[np.float64]

ANNOTS = ("annots.npy", "annots_new.npy")
MILLIMETRES = 1e-3
NAMED_FRAME = re.compile(r"\)_(\d+)")  # CoreView_313_Camera_(1)_0001_2019-08-23_16-08-50.592
CAMERA_FOLDER = re.compile(r"(Camera[_ ]?\(?B?\d+\)?|\d{1,3})")


@dataclass(frozen=True)
class Annots:
    """The raw content of annots.npy.

    Args:
        path: the file.
        K, R, T, D: one entry per camera.
        folders: the image folder of each camera relative to the root; None where the file lists
            no images.
    """

    path: Path
    K: Sequence[Any]
    R: Sequence[Any]
    T: Sequence[Any]
    D: Sequence[Any]
    folders: tuple[str, ...] | None


def frame_number(stem: str) -> int | None:
    """The frame number in an image's name, 313's and 315's long names included."""
    named = NAMED_FRAME.search(stem)
    return frame_of(named[1]) if named else last_number(stem)


def read_annots(root: Path) -> Annots:
    """The first of `ANNOTS` that exists.

    Raises:
        DataError: when it is damaged or its cameras are not complete.
    """
    path = next(root / name for name in ANNOTS if (root / name).exists())
    content = read_npy(path)
    cams = content.get("cams") if isinstance(content, dict) else None
    if not isinstance(cams, dict):
        raise DataError(f"{path} has no 'cams'; expected a dict with cams and ims")
    lists = {}
    for key in ("K", "R", "T", "D"):
        entries = _as_list(cams.get(key))
        if entries is None:
            raise DataError(f"{path}: cams has no list '{key}', one entry per camera")
        lists[key] = entries
    counts = {key: len(value) for key, value in lists.items()}
    if len(set(counts.values())) != 1 or counts["K"] == 0:
        found = ", ".join(f"{n} {key}" for key, n in counts.items())
        raise DataError(f"{path}: cams must hold one K, R, T and D per camera, found {found}")
    folders = _folders(path, content.get("ims"), counts["K"])
    return Annots(path, lists["K"], lists["R"], lists["T"], lists["D"], folders)


def _as_list(value: Any) -> list[Any] | None:
    """The entries of a list or array, None for anything else."""
    if isinstance(value, np.ndarray) and value.ndim > 0:
        return list(value)
    return list(value) if isinstance(value, (list, tuple)) else None


def _folders(path: Path, ims: Any, cameras: int) -> tuple[str, ...] | None:
    """The folder of each camera, the same in every frame, or None without a list of images."""
    first: tuple[str, ...] | None = None
    for number, entry in enumerate(_as_list(ims) or ()):
        names = _as_list(entry.get("ims")) if isinstance(entry, Mapping) else None
        if names is None:
            raise DataError(f"{path}: ims[{number}] has no list 'ims' of image names")
        folders = tuple(str(PurePosixPath(str(name).replace("\\", "/")).parent) for name in names)
        if len(folders) != cameras:
            raise DataError(
                f"{path}: ims[{number}] lists {len(folders)} images, but cams has {cameras} "
                f"cameras; the images' folders are {', '.join(folders[:30])}"
            )
        if first is None:
            first = folders
        elif folders != first:
            other = next(i for i in range(cameras) if folders[i] != first[i])
            raise DataError(
                f"{path}: ims[{number}] has {folders[other]} where ims[0] has {first[other]}; "
                "images must be listed in the order of the cameras"
            )
    if first is not None and len(set(first)) != len(first):
        raise DataError(f"{path}: two cameras share the image folder {first[0]}")
    return first


def camera_folders(root: Path, annots: Annots, notes: list[str]) -> dict[str, str]:
    """Image folder by camera name, in the order of annots.npy.

    A camera's name is its folder's name. Folders come from the list of images; where that is
    empty, from the existing folders, which must be as many as the cameras.

    Raises:
        DataError: when cameras and folders cannot be matched, listing both.
    """
    if annots.folders is not None:
        places = [_place(root, folder) for folder in annots.folders]
        return {PurePosixPath(place).name: place for place in places}
    found = _folders_there(root)
    if len(found) != len(annots.K):
        raise DataError(
            f"{annots.path} has {len(annots.K)} cameras and lists no images, but there are "
            f"{len(found)} image folders ({', '.join(found) or 'none'}); get the annots.npy that "
            "lists them"
        )
    notes.append(f"{annots.path.name} lists no images; the index is rebuilt from the folders")
    return found


def _place(root: Path, folder: str) -> str:
    """The place of a folder that annots.npy names; copies are often rearranged."""
    parts = PurePosixPath(folder).parts
    if not parts or ".." in parts or PurePosixPath(folder).is_absolute():
        raise DataError(f"{root}: annots lists images in {folder!r}, which is not a folder in it")
    for place in (folder, parts[-1], f"images/{parts[-1]}"):
        if (root / place).is_dir():
            return place
    return folder


def _folders_there(root: Path) -> dict[str, str]:
    base = "images/" if (root / "images").is_dir() else ""
    names = [p.name for p in (root / base).iterdir() if p.is_dir()]
    named = sorted((n for n in names if CAMERA_FOLDER.fullmatch(n)), key=natural_order)
    return {name: base + name for name in named}


def index_images(
    root: Path, folders: Mapping[str, str], notes: list[str]
) -> dict[str, dict[int, str]]:
    """The images of each camera by frame number.

    Raises:
        DataError: when there is none at all.
    """
    images = {
        name: frame_files(root, folder, IMAGES, frame_number) for name, folder in folders.items()
    }
    if empty := [name for name, files in images.items() if not files]:
        if len(empty) == len(images):
            raise DataError(
                f"{root}: no camera folder holds images; expected e.g. "
                f"{next(iter(folders.values()))}/000000.jpg"
            )
        notes.append(
            f"{len(empty)} of {len(images)} cameras have no images here: {', '.join(empty)}"
        )
    return images


def annots_cameras(
    root: Path,
    annots: Annots,
    images: Mapping[str, Mapping[int, str]],
    pixel_centre: float,
    rotation_tolerance: float,
    translation: tuple[float, float],
) -> dict[str, CameraEntry]:
    """The cameras by name in metres, in the order of annots.npy.

    Args:
        translation: metres, least and greatest median length of t; units are wrong outside it.

    Raises:
        DataError: naming the camera whose calibration is wrong.
    """
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
            size=picture_size(root, files or some),
            scale=MILLIMETRES,
            pixel_centre=pixel_centre,
            rotation_tolerance=rotation_tolerance,
        )
    length = float(np.median([np.linalg.norm(camera.t) for camera in cameras.values()]))
    if not translation[0] <= length <= translation[1]:
        raise DataError(
            f"{annots.path}: T is {length:.3g} m long (median, taken as millimetres), expected "
            f"{translation[0]:g}-{translation[1]:g} m; this file's T is not in millimetres"
        )
    return cameras


@dataclass(frozen=True)
class Fit:
    """One of the fits that a release may hold.

    Args:
        params: folder of the parameters, one file per frame.
        vertices: folder of the posed vertices.
        pose_blend: the body is posed with pose blend shapes.
    """

    params: str
    vertices: str
    pose_blend: bool


FITS = {
    "refit": Fit("new_params", "new_vertices", True),
    "refined": Fit("smpl_params", "smpl_vertices", True),
    "first": Fit("params", "vertices", False),
}


def choose_fit(root: Path, name: str) -> Fit:
    """The fit of that name, or with "auto" the first of `FITS` that exists.

    Raises:
        DataError: when it does not exist.
    """
    fits = list(FITS.values()) if name == "auto" else [FITS[name]]
    for fit in fits:
        if (root / fit.params).is_dir():
            return fit
    looked = ", ".join(f"{fit.params}/" for fit in fits)
    raise DataError(f"{root} has no SMPL parameters; expected one of the folders {looked}")


def read_motion(
    root: Path, fit: Fit, frames: Iterable[int], model: SkinnedModel, notes: list[str]
) -> Motion:
    """The parameters of the frames that have any, in the model's own convention.

    Raises:
        DataError: on a damaged file or parameters of a wrong size, or when no frame has any.
    """
    files = frame_files(root, fit.params, (".npy",))
    ids = sorted(set(frames) & set(files))
    if not ids:
        some = list(files.values())[:3]
        raise DataError(
            f"{root / fit.params} has no parameters of any frame that has images; it holds "
            f"{len(files)} files ({', '.join(some) or 'none'})"
        )
    entries = {i: (str(root / files[i]), read_npy(root / files[i])) for i in ids}
    return zju_motion(entries, model, notes)


def check_vertices(
    root: Path, fit: Fit, motion: Motion, model: SkinnedModel, count: int, limit: float
) -> bool:
    """Whether the stored vertices were posed with pose blend shapes.

    Args:
        count: frames compared, evenly spaced.
        limit: metres, mean distance between posed and stored vertices.

    Returns:
        The fit's own ``pose_blend``, unless the stored vertices fit the other choice better.

    Raises:
        DataError: when parameters and stored vertices do not belong together.
    """
    files = frame_files(root, fit.vertices, (".npy",))
    ids = [i for i in motion.ids.tolist() if i in files]
    if not ids or count == 0:
        return fit.pose_blend
    chosen = sorted({ids[round(i)] for i in np.linspace(0, len(ids) - 1, count)})
    errors = dict.fromkeys((fit.pose_blend, not fit.pose_blend), 0.0)
    for frame in chosen:
        stored = stored_vertices(root / files[frame], len(model.v_template))
        row = motion.rows([motion.ids.tolist().index(frame)])
        for blend in errors:
            vertices, _ = posed(model, row, blend)
            distance = float(np.linalg.norm(vertices[0] - stored, axis=-1).mean())
            errors[blend] = max(errors[blend], distance)
    best = min(errors, key=errors.__getitem__)  # the fit's own on a tie
    if errors[best] > limit:
        raise DataError(
            f"{root / fit.params} and {root / fit.vertices} do not belong together: posed with "
            f"this body model the vertices are {errors[best] * 100:.1f} cm off on average "
            f"(allowed {limit * 100:g} cm); check data.smpl (neutral), and that neither folder "
            "comes from another release"
        )
    return best


def stored_vertices(path: Path, count: int) -> Float:
    """``[V, 3]`` metres, world.

    Raises:
        DataError: when the file is damaged or of another shape.
    """
    content = read_npy(path)
    if not isinstance(content, np.ndarray) or content.shape != (count, 3):
        found = getattr(content, "shape", type(content).__name__)
        raise DataError(f"{path} must hold vertices of shape ({count}, 3), found {found}")
    if content.dtype.kind not in "fiu" or not np.isfinite(content).all():
        raise DataError(f"{path} must hold finite numbers")
    return content.astype(np.float64)
