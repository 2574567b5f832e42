"""ZJU-MoCap as HumanNeRF and ARAH (3DGS-Avatar) arrange it: caches that hold joints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.body.lbs import axis_angle_to_matrix
from gsgan.body.smpl import SkinnedModel, from_zju
from gsgan.body.smpl_names import CIHP
from gsgan.data.cameras import CameraEntry, make_camera
from gsgan.data.checks import Checks
from gsgan.data.files import frame_files, last_number, read_json
from gsgan.data.formats.common import one_mask_each, picture_size, up_axis
from gsgan.data.formats.smpl_motion import Motion, landmarks_of, one_shape, parameter, refuse_root
from gsgan.data.layout import BodyModel, Found, Meta
from gsgan.data.pixels import IGNORE_LABEL, PixelRules
from gsgan.data.skeletons import Landmarks, make_landmarks
from gsgan.skeleton.smpl import to_mediapipe33
from gsgan.utils.errors import DataError
from gsgan.utils.pickles import read_npz, read_pickle

Float = NDArray[np.float64]

JOINTS = 24
HUMANNERF_CAMERA = "camera"
CIHP_TABLE = tuple(i if i < len(CIHP) else IGNORE_LABEL for i in range(256))
STILL = 1e-6  # by which a camera's numbers may differ between frames
ARAH_SIZES = {
    "root_orient": 3,
    "pose_body": 63,
    "pose_hand": 6,
    "trans": 3,
    "betas": 10,
    "Jtr_posed": JOINTS * 3,
}
JOINTS_ONLY = "smpl24 joints only -> mediapipe33"


def humannerf(
    root: Path, checks: Checks, model: SkinnedModel | None, smpl: Path | None, pixel_centre: float
) -> Found:
    """One camera's view of a subject, as HumanNeRF prepares it.

    The cache has no body shape, so the SMPL file is not used.

    Raises:
        DataError: on a damaged file, or a camera that moves.
    """
    notes = ["this HumanNeRF cache holds one camera and no body shape: no segmentation S"]
    images = {HUMANNERF_CAMERA: frame_files(root, "images", (".png", ".jpg"))}
    masks = frame_files(root, "masks", (".png", ".jpg"))
    if not images[HUMANNERF_CAMERA]:
        raise DataError(f"{root / 'images'} holds no images; expected frame_000000.png and so on")
    camera = _still_camera(root, images[HUMANNERF_CAMERA], pixel_centre, checks)
    motion, joints = _mesh_infos(root / "mesh_infos.pkl")
    return Found(
        root=root,
        meta=Meta(
            up_axis=up_axis([camera]), skeleton_source=JOINTS_ONLY, layout="ZJU-MoCap (HumanNeRF)"
        ),
        cameras={HUMANNERF_CAMERA: camera},
        images=images,
        masks=one_mask_each({HUMANNERF_CAMERA: masks}, "nonzero"),
        mask_folder="masks",
        landmarks=_from_joints(motion.ids, joints, checks, notes, "mesh_infos.pkl"),
        poses=motion.poses("mesh_infos.pkl"),
        pixels=PixelRules(mask_sampling="nearest"),
        calibration=root / "cameras.pkl",
        unit_hint="cameras.pkl and mesh_infos.pkl must both be in metres",
        notes=tuple(notes),
    )


def _still_camera(
    root: Path, images: Mapping[int, str], pixel_centre: float, checks: Checks
) -> CameraEntry:
    path = root / "cameras.pkl"
    entries = _by_frame(path)
    keys = {"intrinsics": 9, "extrinsics": 16}
    first: dict[str, Float] | None = None
    for frame, entry in entries.items():
        where = f"{path}, frame {frame}"
        now = {key: parameter(entry, key, (size,), where) for key, size in keys.items()}
        now["distortions"] = parameter(entry, "distortions", (4, 5, 8), where)
        first = first or now
        if any(not np.allclose(now[key], first[key], STILL, STILL) for key in first):
            raise DataError(f"{where}: the camera moves; expected the same one in every frame")
    assert first is not None  # _by_frame is not empty
    E = first["extrinsics"].reshape(4, 4)
    return make_camera(
        f"{path}, frame {next(iter(entries))}",
        HUMANNERF_CAMERA,
        K=first["intrinsics"].reshape(3, 3),
        R=E[:3, :3],
        t=E[:3, 3],
        dist=first["distortions"],
        size=picture_size(root, images),
        pixel_centre=pixel_centre,
        rotation_tolerance=checks.rotation_tolerance,
    )


def _by_frame(path: Path) -> dict[int, Any]:
    """A pickled dict by frame name (``frame_000012``), by its number."""
    content = read_pickle(path)
    if not isinstance(content, dict) or not content:
        raise DataError(f"{path} must hold a dict with an entry for each frame")
    numbers = {last_number(str(name)): entry for name, entry in content.items()}
    if None in numbers or len(numbers) != len(content):
        names = ", ".join(map(str, list(content)[:3]))
        raise DataError(f"{path}: every key must be a frame's name with its number, found {names}")
    return {int(n): numbers[n] for n in sorted(n for n in numbers if n is not None)}


def _mesh_infos(path: Path) -> tuple[Motion, Float]:
    """The motion, and joints ``[F, 24, 3]`` in the world."""
    entries = _by_frame(path)
    rows = []
    sizes = {"poses": 72, "Rh": 3, "Th": 3, "joints": 72, "tpose_joints": 72}
    for frame, entry in entries.items():
        where = f"{path}, frame {frame}"
        rows.append([parameter(entry, key, (size,), where) for key, size in sizes.items()])
        refuse_root(rows[-1][0], where)
    poses, Rh, Th, joints, rest = (np.stack(column) for column in zip(*rows, strict=True))
    R = axis_angle_to_matrix(torch.from_numpy(Rh)).numpy()
    in_world = joints.reshape(-1, JOINTS, 3) @ R.transpose(0, 2, 1) + Th[:, None]
    theta = poses.reshape(-1, JOINTS, 3).copy()
    theta[:, 0], transl = from_zju(Rh, Th, rest[:, :3])
    ids = np.array(list(entries), np.int64)
    return Motion(ids, theta, transl, np.zeros((len(ids), 0))), in_world


def _from_joints(
    ids: NDArray[np.int64], joints: Float, checks: Checks, notes: list[str], source: str
) -> Landmarks:
    p, conf = to_mediapipe33(joints)
    return make_landmarks(ids, p, conf, checks.max_reach, notes, source)


def arah(
    root: Path, checks: Checks, model: SkinnedModel | None, smpl: Path | None, pixel_centre: float
) -> Found:
    """All cameras of a subject as ARAH prepares them; a model file adds landmarks on vertices.

    Raises:
        DataError: on a damaged file, naming it.
    """
    notes: list[str] = []
    cameras, images = _arah_cameras(root, pixel_centre, checks)
    parts = {name: frame_files(root, name, (".png",)) for name in cameras}
    motion, joints = _arah_models(root, notes)
    if model is None:
        landmarks = _from_joints(motion.ids, joints, checks, notes, "models/")
    else:
        p, conf = landmarks_of(model, motion)
        landmarks = make_landmarks(motion.ids, p, conf, checks.max_reach, notes, "models/")
    betas = tuple(motion.betas[0].tolist())
    return Found(
        root=root,
        meta=Meta(
            up_axis=up_axis(cameras.values()),
            skeleton_source=JOINTS_ONLY if model is None else "smpl24 -> mediapipe33",
            body=None if model is None else BodyModel("smpl", str(smpl), betas),
            label_names=CIHP,
            labels_named_by="CIHP",
            layout="ZJU-MoCap (ARAH)",
        ),
        cameras=cameras,
        images=images,
        masks=one_mask_each(parts, "label"),
        mask_folder="{camera}",
        labels=parts,
        landmarks=landmarks,
        poses=motion.poses("models/"),
        pixels=PixelRules(mask_sampling="nearest", label_table=CIHP_TABLE),
        calibration=root / "cam_params.json",
        unit_hint="cam_params.json and models/ must both be in metres",
        notes=tuple(notes),
    )


def _arah_cameras(
    root: Path, pixel_centre: float, checks: Checks
) -> tuple[dict[str, CameraEntry], dict[str, dict[int, str]]]:
    path = root / "cam_params.json"
    content = read_json(path)
    names = content.get("all_cam_names")
    if not isinstance(names, list) or not names:
        raise DataError(f"{path} has no list 'all_cam_names'")
    cameras, images = {}, {}
    for name in map(str, names):
        where, entry = f"{path}, camera {name}", content.get(name)
        if not isinstance(entry, dict) or any(key not in entry for key in ("K", "R", "T", "D")):
            raise DataError(f"{where}: expected an object with K, R, T and D")
        images[name] = frame_files(root, name, (".jpg", ".jpeg"))
        if not images[name]:
            raise DataError(f"{root / name} holds no images, but {path.name} lists that camera")
        cameras[name] = make_camera(
            where,
            name,
            K=entry["K"],
            R=entry["R"],
            t=entry["T"],
            dist=entry["D"],
            size=picture_size(root, images[name]),
            pixel_centre=pixel_centre,
            rotation_tolerance=checks.rotation_tolerance,
        )
    return cameras, images


def _arah_models(root: Path, notes: list[str]) -> tuple[Motion, Float]:
    files = frame_files(root, "models", (".npz",))
    if not files:
        raise DataError(f"{root / 'models'} holds no 000000.npz and so on")
    rows = []
    for path in files.values():
        content, where = read_npz(root / path, ARAH_SIZES), str(root / path)
        rows.append([parameter(content, key, (n,), where) for key, n in ARAH_SIZES.items()])
    root_orient, body, hand, trans, betas, joints = (
        np.stack(column) for column in zip(*rows, strict=True)
    )
    theta = np.concatenate([root_orient, body, hand], axis=1).reshape(-1, JOINTS, 3)
    shape = one_shape(betas, notes)
    ids = np.array(list(files), np.int64)
    motion = Motion(ids, theta, trans, np.repeat(shape[None], len(ids), axis=0))
    return motion, joints.reshape(-1, JOINTS, 3)
