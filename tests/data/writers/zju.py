"""ZJU-MoCap in each of its layouts, byte-level habits included."""

from pathlib import Path
from typing import Any

import numpy as np
from writers.common import Subject, write_object, write_picture

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


def write_original(
    root: Path,
    subject: Subject,
    *,
    params: str = "new_params",
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
                write_picture(
                    root / f"mask_cihp/{name}/{frame:06d}.png", labels
                )
            if "mask" in masks:
                ones = np.repeat((labels > 0)[..., None], 3, -1).astype(
                    np.uint8
                )
                write_picture(root / f"mask/{name}/{frame:06d}.png", ones)
    write_object(root / "annots.npy", {"cams": _cams(subject), "ims": ims})
    _params(root, params, subject, poses)
    return root


def write_313(
    root: Path,
    subject: Subject,
    numbers: tuple[int, ...],
    renamed: bool = False,
) -> Path:
    """Subjects 313 and 315: ``Camera (1)``, frames from 1, nested lists; long names or, renamed,
    ``Camera (1)/0001.jpg``."""
    ims = []
    for i, frame in enumerate(subject.frames):
        stems = [
            f"{frame:04d}" if renamed else OLD_NAME.format(n, frame)
            for n in numbers
        ]
        ims.append(
            {
                "ims": [
                    f"Camera ({n})/{s}.jpg"
                    for n, s in zip(numbers, stems, strict=True)
                ]
            }
        )
        for c, (n, stem) in enumerate(zip(numbers, stems, strict=True)):
            write_picture(
                root / f"Camera ({n})" / f"{stem}.jpg", subject.images[i][c]
            )
            write_picture(
                root / f"mask_cihp/Camera ({n})" / f"{stem}.png",
                subject.labels[i][c],
            )
    write_object(
        root / "annots.npy", {"cams": _cams(subject, nested=True), "ims": ims}
    )
    _params(root, "params", subject)
    return root


def write_refined(
    root: Path, subject: Subject, listed: str = "backslash"
) -> Path:
    """my_377 and its like: images/00, mask/00, smpl_params. Paths are listed with a "backslash" or
    "slash", or in annots_new.npy alone ("none")."""
    names = [f"{i:02d}" for i in range(len(subject.cameras))]
    ims = []
    for i, frame in enumerate(subject.frames):
        paths = [f"images/{name}/{frame:06d}.jpg" for name in names]
        ims.append(
            {
                "ims": [
                    p.replace("/", "\\") if listed == "backslash" else p
                    for p in paths
                ]
            }
        )
        for c, name in enumerate(names):
            write_picture(root / paths[c], subject.images[i][c])
            person = (subject.labels[i][c] > 0).astype(np.uint8) * 255
            write_picture(root / f"mask/{name}/{frame:06d}.png", person)
    file = "annots_new.npy" if listed == "none" else "annots.npy"
    write_object(
        root / file,
        {"cams": _cams(subject), "ims": [] if listed == "none" else ims},
    )
    _params(root, "smpl_params", subject)
    return root
