"""Reader of the bring-your-own layout.

::

    cameras.json      {camera: {K 3x3, R 3x3, t 3, dist 0/4/5/8, size [w, h]}}
    meta.json         {unit, fps, up_axis, skeleton, pixel_centre, body, label_names, splits, ...}
    images/{camera}/%06d.jpg|png        masks/{camera}/%06d.png   0..255
    labels/{camera}/%06d.png            optional part numbers, 255 = ignore
    landmarks3d.npz   p (F,33,3) NaN = missing, conf (F,33), frame_id (F,)
    hands3d.npz       optional, the same (F,42,3): MediaPipe's 21 of the left hand, then the right
    face3d.npz        optional, the same (F,30,3), names (30,): lips, brows and lids
    body_pose.npz     optional theta (F,bones,3), transl (F,3), frame_id (F,); betas (S,) of SMPL
                      by gsgan.fit also theta_hands and transl_hands, which follow hands3d.npz
    body_shape.npz    optional coefficients (K,), stretch (8,), offsets (33,3), spine (1,), hands
                      (2,2,3) where some were seen: of the free body, by gsgan.fit
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsgan.body.shape import HANDS_SHAPE, STRETCHED, free_space
from gsgan.body.shape import LANDMARKS as LANDMARKS_SHAPE
from gsgan.data.calibration import (
    METRES,
    Conventions,
    choose,
    read_cameras,
    read_conventions,
)
from gsgan.data.cameras import CameraEntry
from gsgan.data.files import FrameFiles, frame_files, read_arrays, read_json
from gsgan.data.formats.common import IMAGES, finish, one_mask_each
from gsgan.data.formats.consistency import Consistency
from gsgan.data.joints import zeros_as_missing
from gsgan.data.layout import BodyModel, Found, Layout, Meta, dataset_folder
from gsgan.data.pixels import PixelRules
from gsgan.data.skeletons import (
    SKELETONS,
    Landmarks,
    Poses,
    make_landmarks,
    whole_frame_ids,
)
from gsgan.data.validation import Thresholds
from gsgan.skeleton.face import FACE, FACE_NAMES
from gsgan.skeleton.hands import HAND
from gsgan.utils.arrays import expect_array
from gsgan.utils.checks import is_number, whole
from gsgan.utils.errors import DataError

LANDMARKS = "landmarks3d.npz"
HANDS_FILE = "hands3d.npz"
FACE_FILE = "face3d.npz"
POSES = "body_pose.npz"
SHAPE = "body_shape.npz"
MASKS = (".png",)
BODY_BONES = {"free": 56, "smpl": 24, "smplx": 55}
SKELETON_LIMITS = Consistency(least_inside=0.2)
"""A capture's own landmarks are noisier than those of a fitted body."""


@dataclass(frozen=True)
class CaptureReader:
    """Reads a capture in the bring-your-own layout; see conf/data/capture.yaml."""

    drop_frames: Any = None
    consistency: Consistency = SKELETON_LIMITS
    ignore_band: int = 0

    def __post_init__(self) -> None:
        whole("data.reader.ignore_band", self.ignore_band, 0)

    def __call__(
        self, root: str | Path, limits: Thresholds, smpl: str | None = None
    ) -> Layout:
        """Reads and checks everything except most images' pixels.

        Args:
            root: the folder that holds cameras.json.
            limits: thresholds.
            smpl: the user's model file, for poses of an SMPL or SMPL-X body.

        Raises:
            DataError: for whatever is missing, damaged or contradictory, naming the file.
        """
        found = _find(
            dataset_folder(root, "cameras.json, images/ and masks/"), limits, smpl, self
        )
        hint = "check that cameras, landmarks and masks belong together"
        return finish(found, limits, self.consistency, hint, self.drop_frames)


def read_capture(
    root: str | Path,
    limits: Thresholds | None = None,
    smpl: str | None = None,
    consistency: Consistency = SKELETON_LIMITS,
    drop_frames: Any = None,
) -> Layout:
    """The capture in a folder, see `CaptureReader`; ``limits`` are `Thresholds()` when None."""
    return CaptureReader(drop_frames, consistency)(root, limits or Thresholds(), smpl)


def _find(
    root: Path, limits: Thresholds, smpl: str | None, reader: CaptureReader
) -> Found:
    notes: list[str] = []
    cameras_json = read_json(root / "cameras.json")
    meta_path = root / "meta.json"
    meta_json = read_json(meta_path)
    meta = _read_meta(meta_path, meta_json, smpl)
    conventions = read_conventions(meta_path, meta_json)
    if conventions.scale != 1.0:
        notes.append(f"lengths converted from {meta.unit} to metres")
    cameras = read_cameras(root / "cameras.json", cameras_json, conventions)
    images = _index_images(root, cameras)
    joints = SKELETONS[meta.skeleton]
    skeletons = _read_landmarks(root / LANDMARKS, joints, conventions, limits, notes)
    hands = None
    if (root / HANDS_FILE).exists():
        hands = _read_landmarks(root / HANDS_FILE, 2 * HAND, conventions, limits, notes)
    face = None
    if (root / FACE_FILE).exists():
        face = _read_landmarks(root / FACE_FILE, FACE, conventions, limits, notes)
        _refuse_other_names(root / FACE_FILE)
    poses = None
    if (root / POSES).exists():
        poses, meta = _read_poses(root, meta, conventions)
    return Found(
        root=root,
        meta=meta,
        cameras=cameras,
        images=images,
        masks=one_mask_each(
            {c: frame_files(root, f"masks/{c}", MASKS) for c in cameras}, "grey"
        ),
        mask_folder="masks/{camera}",
        labels={c: frame_files(root, f"labels/{c}", MASKS) for c in cameras},
        landmarks=skeletons,
        hands=hands,
        face=face,
        poses=poses,
        pixels=PixelRules(
            composed=conventions.composed, unsure_band=reader.ignore_band
        ),
        calibration=root / "cameras.json",
        unit_hint=(
            "check 'unit' in meta.json and that cameras.json and landmarks3d.npz use the same one"
        ),
        notes=tuple(notes),
    )


def _read_meta(path: Path, content: Mapping[str, Any], smpl: str | None) -> Meta:
    """Facts about the capture from the content of meta.json, where only ``unit`` is required."""
    fps = content.get("fps")
    names = content.get("label_names")
    body = content.get("body")
    if fps is not None and not (is_number(fps) and fps > 0):
        raise DataError(f"{path}: 'fps' is {fps!r}; expected a number above 0")
    if names is not None and not (isinstance(names, list) and len(names) > 1):
        raise DataError(
            f"{path}: 'label_names' must list the background and every part by name"
        )
    splits = content.get("splits") or {}
    if not isinstance(splits, dict):
        raise DataError(
            f"{path}: 'splits' must be an object with train_cameras, test_frames, ..."
        )
    if body is not None:
        choose(path, content, "body", None, tuple(BODY_BONES))
    return Meta(
        unit=choose(path, content, "unit", None, tuple(METRES)),
        fps=None if fps is None else float(fps),
        up_axis=choose(
            path, content, "up_axis", "z", ("x", "y", "z", "-x", "-y", "-z")
        ),
        skeleton=choose(path, content, "skeleton", "mediapipe33", tuple(SKELETONS)),
        body=None
        if body is None
        else BodyModel(body, smpl if body != "free" else None),
        label_names=None if names is None else tuple(map(str, names)),
        splits=splits,
    )


def _index_images(
    root: Path, cameras: Mapping[str, CameraEntry]
) -> dict[str, FrameFiles]:
    folder = root / "images"
    if not folder.is_dir():
        raise DataError(
            f"{folder} does not exist; expected images/<camera>/000000.jpg and so on"
        )
    found = {
        p.name for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")
    }
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
    images = {name: frame_files(root, f"images/{name}", IMAGES) for name in cameras}
    if empty := [name for name, files in images.items() if not files]:
        raise DataError(
            f"{folder / empty[0]} holds no frames; expected .jpg or .png images"
        )
    return images


def _read_landmarks(
    path: Path,
    joints: int,
    conventions: Conventions,
    limits: Thresholds,
    notes: list[str],
) -> Landmarks:
    """Skeletons, hands or faces of every frame."""
    arrays = read_arrays(path, ("p", "conf", "frame_id"))
    p = expect_array(arrays, "p", (None, joints, 3), path).astype(np.float64)
    p = zeros_as_missing(p) * conventions.scale
    ids = whole_frame_ids(expect_array(arrays, "frame_id", (len(p),), path), str(path))
    conf = np.ones(p.shape[:2])
    if "conf" in arrays:
        conf = expect_array(arrays, "conf", p.shape[:2], path).astype(np.float64)
    return make_landmarks(ids, p, conf, limits.max_reach, notes, path.name)


def _refuse_other_names(path: Path) -> None:
    """Detectors have hundreds of a face's landmarks: 30 others would be taken for these."""
    names = read_arrays(path, ("names",)).get("names")
    if names is not None and tuple(map(str, names.tolist())) != FACE_NAMES:
        raise DataError(
            f"{path}: 'names' must be those of gsgan.skeleton.face.FACE_NAMES, from "
            f"{FACE_NAMES[0]} to {FACE_NAMES[-1]}; write these 30 landmarks in that order"
        )


def _read_poses(root: Path, meta: Meta, conventions: Conventions) -> tuple[Poses, Meta]:
    """Poses of frames whose numbers are finite, and ``meta`` with the body and its shape."""
    path = root / POSES
    fitted = (root / SHAPE).exists()
    names = ("theta", "transl", "frame_id", "betas", "registered", "fitted_to")
    arrays = read_arrays(path, (*names, "theta_hands", "transl_hands"))
    if fitted:  # by gsgan.fit: the free body in the person's shape
        meta = replace(meta, body=BodyModel("free", betas=read_shape(root / SHAPE)))
    bones = None if meta.body is None else BODY_BONES[meta.body.kind]
    ids = whole_frame_ids(expect_array(arrays, "frame_id", (None,), path), str(path))
    registered: frozenset[int] = frozenset()
    if "registered" in arrays:
        found = expect_array(arrays, "registered", (None,), path)
        registered = frozenset(whole_frame_ids(found, str(path)).tolist())

    parts = [("theta", "transl")]
    if "theta_hands" in arrays:
        parts.append(("theta_hands", "transl_hands"))
    values = [
        tuple(
            expect_array(arrays, name, shape, path).astype(np.float64)
            for name, shape in zip(
                pair, ((len(ids), bones, 3), (len(ids), 3)), strict=True
            )
        )
        for pair in parts
    ]
    finite = np.all(
        [np.isfinite(x).reshape(len(ids), -1).all(1) for pair in values for x in pair],
        axis=0,
    )
    rows = {int(ids[i]): int(i) for i in np.flatnonzero(finite)}
    poses, *with_hands = (
        Poses(
            {f: turns[i] for f, i in rows.items()},
            {f: conventions.scale * moves[i] for f, i in rows.items()},
            fitted=fitted,
            registered=registered,
            fitted_to=tuple(map(str, arrays.get("fitted_to", ()))),
        )
        for turns, moves in values
    )
    if with_hands:
        poses = replace(poses, with_hands=with_hands[0])
    if meta.body is None or "betas" not in arrays:
        return poses, meta
    betas = expect_array(arrays, "betas", (None,), path).astype(np.float64)
    if not np.isfinite(betas).all():
        raise DataError(f"{path}: 'betas' must hold finite numbers")
    return poses, replace(meta, body=replace(meta.body, betas=tuple(betas.tolist())))


def read_shape(path: Path) -> tuple[float, ...]:
    """The free body's shape in a body_shape.npz, as the numbers of `BodyShape.flat`.

    Raises:
        DataError: when the file is damaged or lacks an array.
    """
    K = free_space().coefficients
    names = {
        "coefficients": (K,),
        "stretch": (len(STRETCHED),),
        "offsets": LANDMARKS_SHAPE,
    }
    arrays = read_arrays(path, (*names, "hands", "spine"))
    for name, size in (("hands", HANDS_SHAPE), ("spine", (1,))):
        if name in arrays:
            names[name] = size
    parts = [
        expect_array(arrays, name, shape, path).ravel() for name, shape in names.items()
    ]
    return tuple(np.concatenate(parts).astype(np.float64).tolist())
