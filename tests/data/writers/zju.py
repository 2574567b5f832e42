"""ZJU-MoCap in each of its layouts, byte-level habits included."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from writers.common import Subject, write_object, write_picture

from gsgan.body.smpl import from_zju

OLD_NAME = "CoreView_313_Camera_({})_{:04d}_2019-08-23_16-08-50.592"


def _cams(subject: Subject, nested: bool = False) -> dict[str, list[Any]]:
    rig = subject.cameras
    cams: dict[str, list[Any]] = {
        "K": [c.K for c in rig],
        "R": [c.R for c in rig],
        "T": [c.t[:, None] * 1000 for c in rig],
        "D": [c.dist[:, None] for c in rig],
    }
    if nested:
        cams = {key: [x.tolist() for x in value] for key, value in cams.items()}
    return cams


def _params(root: Path, folder: str, subject: Subject, poses: int = 72) -> None:
    for i, frame in enumerate(subject.frames):
        content = {
            "poses": subject.poses[i][None, 72 - poses :],
            "shapes": subject.shapes[None],
            "Rh": subject.Rh[i][None],
            "Th": subject.Th[i][None],
        }
        write_object(root / folder / f"{frame}.npy", content)


def _vertices(root: Path, folder: str, subject: Subject) -> None:
    (root / folder).mkdir(parents=True, exist_ok=True)
    for i, frame in enumerate(subject.frames):
        np.save(root / folder / f"{frame}.npy", subject.vertices[i].astype(np.float32))


def write_original(
    root: Path,
    subject: Subject,
    *,
    params: str = "new_params",
    vertices: str = "new_vertices",
    poses: int = 72,
    masks: tuple[str, ...] = ("mask_cihp", "mask"),
) -> Path:
    """CoreView_377 and its like: Camera_B1/000000.jpg, mask_cihp/, new_params/ or params/."""
    names = [f"Camera_B{i + 1}" for i in range(len(subject.cameras))]
    ims = []
    for i, frame in enumerate(subject.frames):
        paths = [f"{name}/{frame:06d}.jpg" for name in names]
        ims.append({"ims": paths, "kpts2d": np.zeros((len(names), 25, 3))})
        for c, name in enumerate(names):
            labels = subject.labels[i][c]
            write_picture(root / paths[c], subject.images[i][c])
            if "mask_cihp" in masks:
                write_picture(root / f"mask_cihp/{name}/{frame:06d}.png", labels)
            if "mask" in masks:
                ones = np.repeat((labels > 0)[..., None], 3, -1).astype(np.uint8)
                write_picture(root / f"mask/{name}/{frame:06d}.png", ones)
    write_object(root / "annots.npy", {"cams": _cams(subject), "ims": ims})
    _params(root, params, subject, poses)
    _vertices(root, vertices, subject)
    return root


def write_313(
    root: Path, subject: Subject, numbers: tuple[int, ...], renamed: bool = False
) -> Path:
    """Subjects 313 and 315: ``Camera (1)``, long names, frames from 1, nested lists.

    Args:
        numbers: of the cameras, e.g. (1, 2, 19, 22).
        renamed: ``Camera (1)/0001.jpg``, as some copies have it.
    """
    ims = []
    for i, frame in enumerate(subject.frames):
        stems = [f"{frame:04d}" if renamed else OLD_NAME.format(n, frame) for n in numbers]
        ims.append({"ims": [f"Camera ({n})/{s}.jpg" for n, s in zip(numbers, stems, strict=True)]})
        for c, (n, stem) in enumerate(zip(numbers, stems, strict=True)):
            write_picture(root / f"Camera ({n})" / f"{stem}.jpg", subject.images[i][c])
            write_picture(root / f"mask_cihp/Camera ({n})" / f"{stem}.png", subject.labels[i][c])
    write_object(root / "annots.npy", {"cams": _cams(subject, nested=True), "ims": ims})
    _params(root, "params", subject)
    _vertices(root, "vertices", subject)
    return root


def write_refined(root: Path, subject: Subject, listed: str = "backslash") -> Path:
    """my_377 and its like: images/00, mask/00, smpl_params.

    Args:
        listed: "backslash" or "slash" paths in annots.npy, or "none": annots_new.npy alone, whose
            list of pictures is empty.
    """
    names = [f"{i:02d}" for i in range(len(subject.cameras))]
    ims = []
    for i, frame in enumerate(subject.frames):
        paths = [f"images/{name}/{frame:06d}.jpg" for name in names]
        ims.append({"ims": [p.replace("/", "\\") if listed == "backslash" else p for p in paths]})
        for c, name in enumerate(names):
            write_picture(root / paths[c], subject.images[i][c])
            person = (subject.labels[i][c] > 0).astype(np.uint8) * 255
            write_picture(root / f"mask/{name}/{frame:06d}.png", person)
    file = "annots_new.npy" if listed == "none" else "annots.npy"
    write_object(root / file, {"cams": _cams(subject), "ims": [] if listed == "none" else ims})
    _params(root, "smpl_params", subject)
    _vertices(root, "smpl_vertices", subject)
    return root


def write_humannerf(root: Path, subject: Subject, camera: int = 0) -> Path:
    """One camera's cache: cameras.pkl, mesh_infos.pkl, images/frame_000000.png, 3-channel masks."""
    c = subject.cameras[camera]
    extrinsics = np.eye(4)
    extrinsics[:3, :3], extrinsics[:3, 3] = c.R, c.t
    cameras, infos = {}, {}
    for i, frame in enumerate(subject.frames):
        name = f"frame_{frame:06d}"
        cameras[name] = {"intrinsics": c.K, "extrinsics": extrinsics, "distortions": c.dist}
        infos[name] = {
            "Rh": subject.Rh[i],
            "Th": subject.Th[i],
            "poses": subject.poses[i],
            "joints": subject.joints_before[i],
            "tpose_joints": subject.rest,
        }
        write_picture(root / f"images/{name}.png", subject.images[i][camera])
        person = (subject.labels[i][camera] > 0).astype(np.uint8) * 255
        write_picture(root / f"masks/{name}.png", np.repeat(person[..., None], 3, -1))
    (root / "cameras.pkl").write_bytes(pickle.dumps(cameras))
    (root / "mesh_infos.pkl").write_bytes(pickle.dumps(infos))
    return root


def write_arah(root: Path, subject: Subject) -> Path:
    """ARAH's layout: 1/000000.jpg with 000000.png beside it, cam_params.json, models/000000.npz."""
    params: dict[str, Any] = {"all_cam_names": [str(i + 1) for i in range(len(subject.cameras))]}
    for i, c in enumerate(subject.cameras):
        D, T = c.dist[:, None].tolist(), c.t[:, None].tolist()
        params[str(i + 1)] = {"K": c.K.tolist(), "D": D, "R": c.R.tolist(), "T": T}
    (root / "models").mkdir(parents=True)
    (root / "cam_params.json").write_text(json.dumps(params))
    for i, frame in enumerate(subject.frames):
        orient, transl = from_zju(subject.Rh[i], subject.Th[i], subject.rest[0])
        np.savez(
            root / f"models/{frame:06d}.npz",
            minimal_shape=np.zeros((6890, 3), np.float32),
            betas=subject.shapes[None],
            Jtr_posed=subject.joints[i],
            bone_transforms=np.zeros((24, 4, 4)),
            trans=transl,
            root_orient=orient,
            pose_body=subject.poses[i][3:66],
            pose_hand=subject.poses[i][66:],
        )
        for c in range(len(subject.cameras)):
            write_picture(root / f"{c + 1}/{frame:06d}.jpg", subject.images[i][c])
            write_picture(root / f"{c + 1}/{frame:06d}.png", subject.labels[i][c])
    return root
