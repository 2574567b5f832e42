"""The bring-your-own layout: what lies where, checked before the first picture is decoded.

::

    cameras.json      {camera: {K 3x3, R 3x3, t 3, dist 0/4/5/8, size [w, h]}}
    meta.json         {unit, fps, up_axis, skeleton, pixel_centre, body, label_names, splits, ...}
    images/{camera}/%06d.jpg|png        masks/{camera}/%06d.png   0..255
    labels/{camera}/%06d.png            optional part numbers, 255 = ignore
    landmarks3d.npz   p (F,33,3) NaN = missing, conf (F,33), frame_id (F,)
    body_pose.npz     optional theta (F,bones,3), transl (F,3), frame_id (F,)

Everything is joined by camera name and by the frame number in file names, never by position: one
dropped picture must not shift the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.data.crop import NEAR, inside, project
from gsgan.data.files import (
    check_picture,
    expect_array,
    frame_files,
    read_arrays,
    read_json,
)
from gsgan.errors import DataError

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
SKELETONS = {"mediapipe33": 33}
HUBS = (11, 12, 23, 24)  # shoulders and hips: the bone frames of the whole body hang on them
DISTORTION_LENGTHS = (4, 5, 8)
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
MASK_SUFFIXES = (".png",)
IGNORE_LABEL = 255


FREE_BODY_BONES = 56


@dataclass(frozen=True)
class Checks:
    """What a capture must satisfy; each threshold can be set.

    Args:
        min_joints: a frame with fewer usable joints is dropped.
        min_hubs: the same for shoulders and hips, of which there are four.
        min_joints_in_view: a camera that sees fewer joints of a frame does not use that frame.
        max_reach: metres from the median joint; a joint further out counts as missing.
        rotation_tolerance: largest entry of ``R Rᵀ - I`` allowed.
        distance: metres, least and greatest median distance from the cameras to the person; units
            are wrong outside it.
        max_behind: share of joints behind a camera from which its pose counts as wrong.
    """

    min_joints: int = 12
    min_hubs: int = 3
    min_joints_in_view: int = 4
    max_reach: float = 3.0
    rotation_tolerance: float = 1e-3
    distance: tuple[float, float] = (0.3, 30.0)
    max_behind: float = 0.05


@dataclass(frozen=True)
class CameraEntry:
    """One calibrated camera, float64 numpy.

    Args:
        name: as in cameras.json and in the folder names.
        K: ``[3, 3]`` pixels, pixel centres at +0.5.
        R: ``[3, 3]`` world to camera.
        t: ``[3]`` metres.
        dist: ``[8]`` OpenCV order, zero-padded.
        size: ``(H, W)``.
    """

    name: str
    K: Float
    R: Float
    t: Float
    dist: Float
    size: tuple[int, int]

    @property
    def centre(self) -> Float:
        """``[3]`` metres: where the camera stands."""
        return -self.R.T @ self.t

    @property
    def distorted(self) -> bool:
        """Whether any distortion coefficient is not zero."""
        return bool(np.any(self.dist != 0))


@dataclass(frozen=True)
class Meta:
    """meta.json, known keys only.

    Args:
        scale: metres in one unit of the files.
        unit: as written there.
        fps: frames a second, or None when it is not said.
        up_axis: of the world, e.g. "z" or "-y".
        skeleton: name of the landmark set.
        pixel_centre: 0.5, or 0 when K counts from the centre of the first pixel.
        body: name of the skinned body that body_pose.npz moves, or None.
        label_names: names of the part numbers, background first, or None.
        composed: the images are already composed on black (``"background": "black"``).
        splits: the ``splits`` object, unchecked.
    """

    scale: float
    unit: str
    fps: float | None = None
    up_axis: str = "z"
    skeleton: str = "mediapipe33"
    pixel_centre: float = 0.5
    body: str | None = None
    label_names: tuple[str, ...] | None = None
    composed: bool = False
    splits: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Landmarks:
    """Skeletons by frame: ``p [J, 3]`` metres, finite, ``visibility [J]`` in [0, 1].

    A joint of visibility 0 is a stand-in for one that was not seen.
    """

    p: Mapping[int, Float]
    visibility: Mapping[int, Float]


@dataclass(frozen=True)
class Poses:
    """Body poses by frame: ``theta [bones, 3]`` axis-angle, ``transl [3]`` metres."""

    theta: Mapping[int, Float]
    transl: Mapping[int, Float]


@dataclass(frozen=True)
class Layout:
    """A capture on disk, validated and indexed; no picture is decoded.

    Args:
        root: the folder.
        meta: what meta.json says.
        cameras: by name, in the order of cameras.json; `camera_index` counts in that order.
        frames: usable frame numbers, rising.
        images: file names by camera and frame, usable ones only.
        masks: the same for masks.
        labels: the same for part labels; empty when the capture has none.
        landmarks: by frame.
        poses: by frame, or None.
        notes: one sentence for each thing converted, dropped or left out.
    """

    root: Path
    meta: Meta
    cameras: Mapping[str, CameraEntry]
    frames: tuple[int, ...]
    images: Mapping[str, Mapping[int, str]]
    masks: Mapping[str, Mapping[int, str]]
    labels: Mapping[str, Mapping[int, str]]
    landmarks: Landmarks
    poses: Poses | None
    notes: tuple[str, ...]

    @classmethod
    def read(cls, root: str | Path, checks: Checks | None = None) -> Layout:
        """Reads and checks everything but the pictures' pixels.

        Args:
            root: the folder that holds cameras.json.
            checks: thresholds, `Checks()` when None.

        Raises:
            DataError: for whatever is missing, damaged or contradictory, naming the file.
        """
        checks = checks or Checks()
        root = Path(root).expanduser()
        if not root.is_dir():
            what = "is a file, not a folder" if root.exists() else "does not exist"
            raise DataError(
                f"data.root={root} {what}; expected the folder that holds cameras.json, images/ "
                "and masks/"
            )
        notes: list[str] = []
        cameras_json = read_json(root / "cameras.json")
        meta = read_meta(root / "meta.json")
        if meta.scale != 1.0:
            notes.append(f"lengths converted from {meta.unit} to metres")
        cameras = read_cameras(root / "cameras.json", cameras_json, meta, checks)
        images = _index_images(root, cameras)
        landmarks = read_landmarks(root / "landmarks3d.npz", meta, checks, notes)
        poses = None
        if (root / "body_pose.npz").exists():
            poses = read_poses(root / "body_pose.npz", meta)
        images = _drop_frames(root, images, landmarks, poses, checks, notes)
        _check_geometry(root, cameras, images, landmarks, checks)
        images = _drop_unseen(root, cameras, images, landmarks, checks, notes)
        masks = _index_masks(root, images)
        labels = _index_labels(root, images, notes)
        _check_pictures(root, cameras, images, masks, labels)
        return cls(
            root=root,
            meta=meta,
            cameras=cameras,
            frames=tuple(sorted({f for names in images.values() for f in names})),
            images=images,
            masks=masks,
            labels=labels,
            landmarks=landmarks,
            poses=poses,
            notes=tuple(notes),
        )

    @property
    def camera_names(self) -> tuple[str, ...]:
        """All cameras, in the order that `camera_index` counts."""
        return tuple(self.cameras)

    def image_path(self, camera: str, frame: int) -> Path:
        """The picture of a camera and frame."""
        return self.root / "images" / camera / self.images[camera][frame]

    def mask_path(self, camera: str, frame: int) -> Path:
        """The mask of a camera and frame."""
        return self.root / "masks" / camera / self.masks[camera][frame]

    def label_path(self, camera: str, frame: int) -> Path | None:
        """The part labels of a camera and frame, or None when it has none."""
        name = self.labels.get(camera, {}).get(frame)
        return None if name is None else self.root / "labels" / camera / name


def read_meta(path: Path) -> Meta:
    """meta.json; only ``unit`` must be there.

    Raises:
        DataError: on a missing unit or a value out of its set.
    """
    content = read_json(path)

    def choose(key: str, default: Any, allowed: tuple[Any, ...]) -> Any:
        value = content.get(key, default)
        if value not in allowed:
            names = ", ".join(map(str, allowed))
            raise DataError(f"{path}: '{key}' is {value!r}; expected one of {names}")
        return value

    unit = choose("unit", None, tuple(METRES))
    fps = content.get("fps")
    if fps is not None and not (isinstance(fps, (int, float)) and fps > 0):
        raise DataError(f"{path}: 'fps' is {fps!r}; expected a number above 0")
    names = content.get("label_names")
    if names is not None and not (isinstance(names, list) and len(names) > 1):
        raise DataError(f"{path}: 'label_names' must list the background and every part by name")
    splits = content.get("splits") or {}
    if not isinstance(splits, dict):
        raise DataError(f"{path}: 'splits' must be an object with train_cameras, test_frames, ...")
    return Meta(
        scale=METRES[unit],
        unit=unit,
        fps=None if fps is None else float(fps),
        up_axis=choose("up_axis", "z", ("x", "y", "z", "-x", "-y", "-z")),
        skeleton=choose("skeleton", "mediapipe33", tuple(SKELETONS)),
        pixel_centre=choose("pixel_centre", 0.5, (0, 0.5)),
        body=content.get("body"),
        label_names=None if names is None else tuple(map(str, names)),
        composed=choose("background", "scene", ("scene", "black")) == "black",
        splits=splits,
    )


def read_cameras(
    path: Path, content: Mapping[str, Any], meta: Meta, checks: Checks
) -> dict[str, CameraEntry]:
    """The cameras of cameras.json by name, in metres, pixel centres moved to +0.5.

    Raises:
        DataError: naming the camera and what is wrong with its calibration.
    """
    if not content:
        raise DataError(f"{path} lists no camera")
    return {
        name: _camera(f"{path}, camera {name}", name, entry, meta, checks)
        for name, entry in content.items()
    }


def _camera(where: str, name: str, entry: Any, meta: Meta, checks: Checks) -> CameraEntry:
    if not isinstance(entry, dict):
        raise DataError(f"{where}: expected an object with K, R, t, dist and size")
    K = _numbers(where, entry, "K", (3, 3))
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise DataError(
            f"{where}: the focal lengths in K must be above 0, found {K[0, 0]:g} and {K[1, 1]:g}"
        )
    if K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
        raise DataError(
            f"{where}: K must be [[fx, s, cx], [0, fy, cy], [0, 0, 1]], found {K.tolist()}"
        )
    K[:2, 2] += 0.5 - meta.pixel_centre
    R = _numbers(where, entry, "R", (3, 3))
    _check_rotation(where, R, checks.rotation_tolerance)
    size = _numbers(where, entry, "size", (2,))
    if np.any(size < 1) or np.any(size != np.round(size)):
        raise DataError(f"{where}: size must be [width, height] in pixels, found {entry['size']}")
    return CameraEntry(
        name=name,
        K=K,
        R=R,
        t=_numbers(where, entry, "t", (3,)) * meta.scale,
        dist=_distortion(where, entry),
        size=(int(size[1]), int(size[0])),
    )


def _numbers(where: str, entry: Mapping[str, Any], key: str, shape: tuple[int, ...]) -> Float:
    if key not in entry:
        raise DataError(f"{where}: '{key}' is missing; expected K, R, t, dist and size")
    try:
        array = np.array(entry[key], np.float64)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.size == int(np.prod(shape)) and array.ndim > len(shape):
        array = array.reshape(shape)  # a translation is often written as a column
    if array.shape != shape or not np.isfinite(array).all():
        raise DataError(
            f"{where}: '{key}' must hold finite numbers of shape {shape}, found {entry[key]!r}"
        )
    return array


def _check_rotation(where: str, R: Float, tolerance: float) -> None:
    error = np.abs(R @ R.T - np.eye(3)).max()
    if error > tolerance:
        raise DataError(
            f"{where}: R is not a rotation, R Rᵀ differs from the identity by {error:.3g} "
            f"(allowed {tolerance:g})"
        )
    if np.linalg.det(R) < 0:
        raise DataError(
            f"{where}: R mirrors (determinant -1); expected a rotation, world to OpenCV camera axes"
        )


def _distortion(where: str, entry: Mapping[str, Any]) -> Float:
    raw = entry.get("dist")
    padded = np.zeros(8)
    if raw is None or (isinstance(raw, list) and not raw):
        return padded
    try:
        dist = np.array(raw, np.float64).reshape(-1)
    except (TypeError, ValueError):
        dist = np.full(1, np.nan)
    if len(dist) not in DISTORTION_LENGTHS or not np.isfinite(dist).all():
        raise DataError(
            f"{where}: dist must hold 4, 5 or 8 finite numbers (k1 k2 p1 p2 k3 ...), found {raw!r}"
        )
    padded[: len(dist)] = dist
    return padded


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
    images = {name: frame_files(folder / name, IMAGE_SUFFIXES) for name in cameras}
    if empty := [name for name, files in images.items() if not files]:
        raise DataError(f"{folder / empty[0]} holds no frames; expected .jpg or .png pictures")
    return images


def read_landmarks(path: Path, meta: Meta, checks: Checks, notes: list[str]) -> Landmarks:
    """Skeletons of every frame, holes filled with stand-ins of visibility 0.

    A joint is missing where it is not finite, its confidence is not above 0, or it lies further
    than ``checks.max_reach`` from the rest of the body. It then stands where it was in the nearest
    frame that has it, or at the mean of the frame's joints.

    Raises:
        DataError: on wrong arrays.
    """
    joints = SKELETONS[meta.skeleton]
    arrays = read_arrays(path, ("p", "conf", "frame_id"))
    p = expect_array(arrays, "p", (None, joints, 3), path).astype(np.float64) * meta.scale
    ids = _frame_ids(arrays, len(p), path)
    conf = np.ones(p.shape[:2])
    if "conf" in arrays:
        conf = expect_array(arrays, "conf", p.shape[:2], path).astype(np.float64)
    visibility = np.where(np.isfinite(p).all(-1), np.nan_to_num(conf), 0.0).clip(0, 1)
    far = _far_joints(p, visibility > 0, checks.max_reach)
    if far.any():
        visibility[far] = 0
        notes.append(
            f"{int(far.sum())} joints further than {checks.max_reach:g} m from the body are taken "
            "as missing"
        )
    order = np.argsort(ids)
    p, visibility, ids = p[order], visibility[order], ids[order]
    p = fill_missing(p, visibility > 0, ids)
    frames = [int(i) for i in ids]
    return Landmarks(dict(zip(frames, p, strict=True)), dict(zip(frames, visibility, strict=True)))


def _frame_ids(arrays: dict[str, NDArray[Any]], count: int, path: Path) -> NDArray[np.int64]:
    raw = expect_array(arrays, "frame_id", (count,), path)
    ids = np.asarray(raw, np.int64)
    if not np.array_equal(ids, raw):
        raise DataError(f"{path}: 'frame_id' must hold whole numbers")
    values, counts = np.unique(ids, return_counts=True)
    if len(values) != len(ids):
        raise DataError(f"{path}: frame_id {values[counts > 1][0]} appears more than once")
    return ids


def _far_joints(p: Float, valid: Bool, reach: float) -> Bool:
    centre = np.zeros((len(p), 1, 3))
    some = valid.any(-1)
    centre[some, 0] = np.nanmedian(np.where(valid[some, :, None], p[some], np.nan), axis=1)
    distance = np.linalg.norm(np.nan_to_num(p, posinf=0, neginf=0) - centre, axis=-1)
    return valid & (distance > reach)


def fill_missing(p: Float, valid: Bool, ids: NDArray[np.int64]) -> Float:
    """Finite stand-ins for missing joints.

    Args:
        p: ``[F, J, 3]``, anything where not valid.
        valid: ``[F, J]``.
        ids: ``[F]`` rising frame numbers: what counts as near in time.

    Returns:
        ``[F, J, 3]``: the joint of the nearest frame that has it (the earlier of two), else the
        mean of the frame's valid joints, else 0.
    """
    filled = np.where(valid[..., None], p, 0.0)
    count = valid.sum(1, keepdims=True).clip(1)
    means = filled.sum(1) / count
    for joint in range(p.shape[1]):
        known = np.flatnonzero(valid[:, joint])
        holes = np.flatnonzero(~valid[:, joint])
        if len(known) == 0:
            filled[:, joint] = means
            continue
        after = np.searchsorted(known, holes).clip(0, len(known) - 1)
        before = (np.searchsorted(known, holes) - 1).clip(0)
        back = np.abs(ids[holes] - ids[known[before]])
        ahead = np.abs(ids[known[after]] - ids[holes])
        filled[holes, joint] = p[known[np.where(back <= ahead, before, after)], joint]
    return filled


def read_poses(path: Path, meta: Meta) -> Poses:
    """Body poses; frames whose numbers are not finite are left out.

    Raises:
        DataError: on wrong arrays.
    """
    arrays = read_arrays(path, ("theta", "transl", "frame_id"))
    bones = FREE_BODY_BONES if meta.body == "free" else None
    theta = expect_array(arrays, "theta", (None, bones, 3), path).astype(np.float64)
    transl = expect_array(arrays, "transl", (len(theta), 3), path).astype(np.float64) * meta.scale
    ids = _frame_ids(arrays, len(theta), path)
    finite = np.isfinite(theta).all((1, 2)) & np.isfinite(transl).all(1)
    rows = {int(ids[i]): int(i) for i in np.flatnonzero(finite)}
    return Poses({f: theta[i] for f, i in rows.items()}, {f: transl[i] for f, i in rows.items()})


def _drop_frames(
    root: Path,
    images: dict[str, dict[int, str]],
    landmarks: Landmarks,
    poses: Poses | None,
    checks: Checks,
    notes: list[str],
) -> dict[str, dict[int, str]]:
    frames = sorted({frame for files in images.values() for frame in files})
    dropped: dict[str, list[int]] = {}
    for frame in frames:
        if reason := _unusable(frame, landmarks, poses, checks):
            dropped.setdefault(reason, []).append(frame)
    for reason, ids in dropped.items():
        notes.append(f"{len(ids)} of {len(frames)} frames dropped, {reason}: {spans(ids)}")
    gone = {frame for ids in dropped.values() for frame in ids}
    if len(gone) == len(frames):
        raise DataError(
            f"{root} (landmarks3d.npz) has no usable frame: "
            + "; ".join(f"{len(ids)} {reason}" for reason, ids in dropped.items())
        )
    if unseen := len(set(landmarks.p) - set(frames)):
        notes.append(f"{unseen} frames in landmarks3d.npz have no picture and are not used")
    uneven = [f"{name} {len(files)}" for name, files in images.items() if len(files) < len(frames)]
    if uneven:
        notes.append(
            f"cameras with fewer than the {len(frames)} frames of all together: "
            f"{', '.join(uneven)} (matched by frame number)"
        )
    return {name: {f: files[f] for f in files if f not in gone} for name, files in images.items()}


def _unusable(frame: int, landmarks: Landmarks, poses: Poses | None, checks: Checks) -> str | None:
    if frame not in landmarks.visibility:
        return "without a row in landmarks3d.npz"
    valid = landmarks.visibility[frame] > 0
    if valid.sum() < checks.min_joints:
        return f"with fewer than {checks.min_joints} joints (NaN or confidence 0)"
    if valid[list(HUBS)].sum() < checks.min_hubs:
        return f"with fewer than {checks.min_hubs} of the shoulders and hips"
    if poses is not None and frame not in poses.theta:
        return "without a finite row in body_pose.npz"
    return None


def spans(ids: list[int]) -> str:
    """Numbers as ranges: [1, 2, 3, 7] is "1-3, 7"."""
    ids = sorted(ids)
    starts = [i for i in range(len(ids)) if i == 0 or ids[i] != ids[i - 1] + 1]
    ends = [*(i - 1 for i in starts[1:]), len(ids) - 1]
    parts = [
        f"{ids[a]}" if a == b else f"{ids[a]}-{ids[b]}" for a, b in zip(starts, ends, strict=True)
    ]
    return ", ".join(parts)


def _check_geometry(
    root: Path,
    cameras: Mapping[str, CameraEntry],
    images: Mapping[str, Mapping[int, str]],
    landmarks: Landmarks,
    checks: Checks,
) -> None:
    """Cameras must stand at a believable distance and look at the person."""
    frames = sorted({f for files in images.values() for f in files})
    joints = np.stack([landmarks.p[f] for f in frames])
    valid = np.stack([landmarks.visibility[f] for f in frames]) > 0
    centre = np.median(joints[valid], axis=0)
    distance = float(np.median([np.linalg.norm(c.centre - centre) for c in cameras.values()]))
    low, high = checks.distance
    if not low <= distance <= high:
        raise DataError(
            f"{root}: cameras stand {distance:.3g} m from the person (median), expected "
            f"{low:g}-{high:g} m; check 'unit' in meta.json and that cameras.json and "
            "landmarks3d.npz use the same one"
        )
    for camera in cameras.values():
        depth = project(camera, joints)[1][valid]
        behind = float((depth <= NEAR).mean())
        if behind > checks.max_behind:
            raise DataError(
                f"{root / 'cameras.json'}, camera {camera.name}: {behind:.0%} of the joints lie "
                "behind it; R and t must map world to camera (x_cam = R x + t), z forward"
            )


def _drop_unseen(
    root: Path,
    cameras: Mapping[str, CameraEntry],
    images: Mapping[str, Mapping[int, str]],
    landmarks: Landmarks,
    checks: Checks,
    notes: list[str],
) -> dict[str, dict[int, str]]:
    kept: dict[str, dict[int, str]] = {}
    for name, files in images.items():
        frames = list(files)
        if not frames:
            kept[name] = {}
            continue
        seen = inside(cameras[name], np.stack([landmarks.p[f] for f in frames]))
        seen &= np.stack([landmarks.visibility[f] for f in frames]) > 0
        enough = seen.sum(1) >= checks.min_joints_in_view
        if not enough.any():
            raise DataError(
                f"{root / 'cameras.json'}, camera {name}: no frame has "
                f"{checks.min_joints_in_view} joints inside the picture; check K, and that R and t "
                "map world to camera (x_cam = R x + t)"
            )
        if not enough.all():
            lost = [f for f, ok in zip(frames, enough, strict=True) if not ok]
            notes.append(
                f"camera {name}: {len(lost)} frames dropped, fewer than "
                f"{checks.min_joints_in_view} joints in view: {spans(lost)}"
            )
        kept[name] = {f: files[f] for f, ok in zip(frames, enough, strict=True) if ok}
    return kept


def _index_masks(root: Path, images: Mapping[str, Mapping[int, str]]) -> dict[str, dict[int, str]]:
    masks: dict[str, dict[int, str]] = {}
    for name, files in images.items():
        folder = root / "masks" / name
        found = frame_files(folder, MASK_SUFFIXES) if folder.is_dir() else {}
        if missing := [f for f in files if f not in found]:
            expected = (folder / files[missing[0]]).with_suffix(".png")
            raise DataError(
                f"{expected} does not exist; every picture needs a mask, and {len(missing)} of "
                f"the {len(files)} of camera {name} are missing"
            )
        masks[name] = {f: found[f] for f in files}
    return masks


def _index_labels(
    root: Path, images: Mapping[str, Mapping[int, str]], notes: list[str]
) -> dict[str, dict[int, str]]:
    labels: dict[str, dict[int, str]] = {}
    for name, files in images.items():
        folder = root / "labels" / name
        found = frame_files(folder, MASK_SUFFIXES) if folder.is_dir() else {}
        labels[name] = {f: found[f] for f in files if f in found}
    pictures = sum(len(files) for files in images.values())
    lacking = pictures - sum(len(files) for files in labels.values())
    if 0 < lacking < pictures:
        notes.append(f"{lacking} of {pictures} pictures have no labels, they count as 'ignore'")
    return labels if lacking < pictures else {}


def _check_pictures(
    root: Path,
    cameras: Mapping[str, CameraEntry],
    images: Mapping[str, Mapping[int, str]],
    masks: Mapping[str, Mapping[int, str]],
    labels: Mapping[str, Mapping[int, str]],
) -> None:
    """Sizes and channel layouts, from the headers alone."""
    for name, files in images.items():
        size = cameras[name].size
        for frame, file in files.items():
            image = root / "images" / name / file
            check_picture(image, "image", size, str(root / "cameras.json"))
            by = f"the picture {image}"
            check_picture(root / "masks" / name / masks[name][frame], "mask", size, by)
            if label := labels.get(name, {}).get(frame):
                check_picture(root / "labels" / name / label, "labels", size, by)
