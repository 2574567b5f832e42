"""Reader of the bring-your-own layout.

::

    cameras.json      {camera: {K 3x3, R 3x3, t 3, dist 0/4/5/8, size [w, h]}}
    meta.json         {unit, fps, up_axis, skeleton, pixel_centre, body, label_names, splits, ...}
    images/{camera}/%06d.jpg|png        masks/{camera}/%06d.png   0..255
    labels/{camera}/%06d.png            optional part numbers, 255 = ignore
    landmarks3d.npz   p (F,33,3) NaN = missing, conf (F,33), frame_id (F,)
    body_pose.npz     optional theta (F,bones,3), transl (F,3), frame_id (F,); betas (S,) of SMPL
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsgan.data.cameras import EXPECTED, CameraEntry, make_camera, numbers
from gsgan.data.checks import Checks
from gsgan.data.files import frame_files, read_arrays, read_json
from gsgan.data.formats.capture_meta import BODY_BONES, Conventions, read_meta
from gsgan.data.formats.common import without_frames
from gsgan.data.formats.trust import Trust, check_meeting, watch_masks
from gsgan.data.layout import Found, Layout, Meta, assemble, dataset_folder
from gsgan.data.pixels import MaskFile, PixelRules
from gsgan.data.skeletons import (
    SKELETONS,
    Landmarks,
    Poses,
    make_landmarks,
    whole_frame_ids,
)
from gsgan.utils.arrays import expect_array
from gsgan.utils.errors import DataError

LANDMARKS = "landmarks3d.npz"
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
MASK_SUFFIXES = (".png",)
LOOKED_AT = Trust(min_box_iou=0.0)
"""Landmarks lie inside the body and may lack limbs: their box says little about the mask's."""


@dataclass(frozen=True)
class CaptureReader:
    """Reads a capture in the bring-your-own layout; what is looked at is a setting.

    Args:
        landmarks: the skeletons' file, in the capture's folder unless its path is absolute; None
            is landmarks3d.npz.
        drop_frames: frames to leave out, e.g. "360-370", or None.
        trust: which pictures are looked at.
    """

    landmarks: str | None = None
    drop_frames: Any = None
    trust: Trust = LOOKED_AT

    def __call__(self, root: str | Path, checks: Checks, smpl: str | None = None) -> Layout:
        """See `read_capture`."""
        return read_capture(root, checks, smpl, self.trust, self.drop_frames, self.landmarks)


def read_capture(
    root: str | Path,
    checks: Checks | None = None,
    smpl: str | None = None,
    trust: Trust = LOOKED_AT,
    drop_frames: Any = None,
    landmarks: str | None = None,
) -> Layout:
    """Reads and checks everything but most pictures' pixels.

    Args:
        root: the folder that holds cameras.json.
        checks: thresholds, `Checks()` when None.
        smpl: the user's model file, for poses of an SMPL or SMPL-X body.
        trust: which pictures are looked at.
        drop_frames: frames to leave out, e.g. "360-370", or None.
        landmarks: the skeletons' file, in the folder unless its path is absolute; None is
            landmarks3d.npz.

    Raises:
        DataError: for whatever is missing, damaged or contradictory, naming the file.
    """
    checks = checks or Checks()
    root = dataset_folder(root, "cameras.json, images/ and masks/")
    notes: list[str] = []
    cameras_json = read_json(root / "cameras.json")
    meta, conventions = read_meta(root / "meta.json", smpl)
    if conventions.scale != 1.0:
        notes.append(f"lengths converted from {meta.unit} to metres")
    cameras = read_cameras(root / "cameras.json", cameras_json, conventions, checks)
    images = _index_images(root, cameras)
    joints_file = landmarks_path(root, landmarks)
    if joints_file != root / LANDMARKS:
        notes.append(f"skeletons come from {landmarks}, not from {LANDMARKS}")
    skeletons = read_landmarks(joints_file, meta, conventions, checks, notes)
    poses = None
    if (root / "body_pose.npz").exists():
        poses = read_poses(root / "body_pose.npz", meta, conventions)
        meta = _with_shape(meta, root / "body_pose.npz")
    masks = {name: _files_of(root, "masks", name) for name in cameras}
    found = Found(
        root=root,
        meta=meta,
        cameras=cameras,
        images=images,
        masks={
            name: {f: (MaskFile("grey", path),) for f, path in files.items()}
            for name, files in masks.items()
        },
        mask_folders={name: root / "masks" / name for name in cameras},
        labels={name: _files_of(root, "labels", name) for name in cameras},
        landmarks=skeletons,
        poses=poses,
        pixels=PixelRules(composed=conventions.composed),
        calibration=root / "cameras.json",
        unit_hint=(
            "check 'unit' in meta.json and that cameras.json and landmarks3d.npz use the same one"
        ),
        notes=tuple(notes),
    )
    layout = assemble(without_frames(found, drop_frames), checks)
    doubts = check_meeting(
        layout,
        layout.landmarks.seen,
        trust,
        "check that cameras, landmarks and masks belong together",
    )
    return replace(layout, notes=(*layout.notes, *doubts, *watch_masks(layout, trust)))


def landmarks_path(root: Path, name: str | None) -> Path:
    """The skeletons' file: in the capture's folder unless its path is absolute.

    Raises:
        DataError: when it is not there, or no npz.
    """
    if name is None:
        return root / LANDMARKS
    if not isinstance(name, str) or not name.endswith(".npz"):
        raise DataError(f"data.reader.landmarks must name an .npz file, got {name!r}")
    path = root / Path(name).expanduser()
    if not path.is_file():
        raise DataError(
            f"data.reader.landmarks={name}: {path} does not exist; gsgan.fit makes such files"
        )
    return path


def read_cameras(
    path: Path, content: Mapping[str, Any], conventions: Conventions, checks: Checks
) -> dict[str, CameraEntry]:
    """The cameras of cameras.json by name, in metres, pixel centres moved to +0.5.

    Raises:
        DataError: naming the camera and what is wrong with its calibration.
    """
    if not content:
        raise DataError(f"{path} lists no camera")
    return {
        name: _camera(f"{path}, camera {name}", name, entry, conventions, checks)
        for name, entry in content.items()
    }


def _camera(
    where: str, name: str, entry: Any, conventions: Conventions, checks: Checks
) -> CameraEntry:
    if not isinstance(entry, dict):
        raise DataError(f"{where}: expected an object with {EXPECTED}")
    for key in ("K", "R", "t", "size"):
        if key not in entry:
            raise DataError(f"{where}: '{key}' is missing; expected {EXPECTED}")
    size = numbers(where, entry["size"], "size", (2,))
    if np.any(size < 1) or np.any(size != np.round(size)):
        raise DataError(f"{where}: size must be [width, height] in pixels, found {entry['size']}")
    return make_camera(
        where,
        name,
        K=entry["K"],
        R=entry["R"],
        t=entry["t"],
        dist=entry.get("dist"),
        size=(int(size[1]), int(size[0])),
        scale=conventions.scale,
        pixel_centre=conventions.pixel_centre,
        rotation_tolerance=checks.rotation_tolerance,
    )


def _with_shape(meta: Meta, path: Path) -> Meta:
    """The body with the shape that body_pose.npz gives, the mean shape where it gives none."""
    arrays = read_arrays(path, ("betas",))
    if meta.body is None or not arrays:
        return meta
    betas = expect_array(arrays, "betas", (None,), path).astype(np.float64)
    if not np.isfinite(betas).all():
        raise DataError(f"{path}: 'betas' must hold finite numbers")
    return replace(meta, body=replace(meta.body, betas=tuple(betas.tolist())))


def _index_images(root: Path, cameras: Mapping[str, CameraEntry]) -> dict[str, dict[int, str]]:
    folder = root / "images"
    if not folder.is_dir():
        raise DataError(f"{folder} does not exist; expected images/<camera>/000000.jpg and so on")
    found = {p.name for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")}
    if unknown := sorted(found - set(cameras)):
        raise DataError(
            f"{folder} has the camera {unknown[0]}, which {root / 'cameras.json'} does not list; "
            f"it lists {', '.join(cameras)}"
        )
    if missing := [name for name in cameras if name not in found]:
        raise DataError(
            f"{root / 'cameras.json'} lists the camera {missing[0]}, but {folder / missing[0]} "
            f"does not exist; there are {', '.join(sorted(found)) or 'none'}"
        )
    images = {name: _files_of(root, "images", name, IMAGE_SUFFIXES) for name in cameras}
    if empty := [name for name, files in images.items() if not files]:
        raise DataError(f"{folder / empty[0]} holds no frames; expected .jpg or .png pictures")
    return images


def _files_of(
    root: Path, kind: str, camera: str, suffixes: tuple[str, ...] = MASK_SUFFIXES
) -> dict[int, str]:
    return frame_files(root, f"{kind}/{camera}", suffixes)


def read_landmarks(
    path: Path, meta: Meta, conventions: Conventions, checks: Checks, notes: list[str]
) -> Landmarks:
    """Skeletons of every frame, see `make_landmarks`.

    Raises:
        DataError: on wrong arrays.
    """
    joints = SKELETONS[meta.skeleton]
    arrays = read_arrays(path, ("p", "conf", "frame_id", "fitted_to"))
    p = expect_array(arrays, "p", (None, joints, 3), path).astype(np.float64) * conventions.scale
    ids = whole_frame_ids(expect_array(arrays, "frame_id", (len(p),), path), str(path))
    conf = np.ones(p.shape[:2])
    if "conf" in arrays:
        conf = expect_array(arrays, "conf", p.shape[:2], path).astype(np.float64)
    found = make_landmarks(ids, p, conf, checks.max_reach, notes, path.name)
    cameras = arrays.get("fitted_to", np.array([], str))
    if cameras.ndim != 1 or cameras.dtype.kind != "U":
        raise DataError(f"{path}: 'fitted_to' must list camera names; run gsgan.fit again")
    return replace(found, fitted_to=tuple(cameras.tolist()))


def read_poses(path: Path, meta: Meta, conventions: Conventions) -> Poses:
    """Body poses; frames whose numbers are not finite are left out.

    Raises:
        DataError: on wrong arrays.
    """
    arrays = read_arrays(path, ("theta", "transl", "frame_id"))
    bones = None if meta.body is None else BODY_BONES[meta.body.kind]
    theta = expect_array(arrays, "theta", (None, bones, 3), path).astype(np.float64)
    transl = expect_array(arrays, "transl", (len(theta), 3), path).astype(np.float64)
    transl = transl * conventions.scale
    ids = whole_frame_ids(expect_array(arrays, "frame_id", (len(theta),), path), str(path))
    finite = np.isfinite(theta).all((1, 2)) & np.isfinite(transl).all(1)
    rows = {int(ids[i]): int(i) for i in np.flatnonzero(finite)}
    return Poses({f: theta[i] for f, i in rows.items()}, {f: transl[i] for f, i in rows.items()})
