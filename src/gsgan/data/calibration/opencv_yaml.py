"""OpenCV YAML in two files, intri.yml and extri.yml, as EasyMocap writes them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from gsgan.data.calibration.opencv_storage import Storage, read_storage
from gsgan.data.cameras import CameraEntry, make_camera, numbers
from gsgan.utils.errors import DataError

MAX_LENS = 8  # coefficients that are understood
SAME_ROTATION = 1e-3  # largest entry in which Rot_ and R_ of one camera may differ


def read_opencv_yaml(
    path: Path, scale: float | None, pixel_centre: float
) -> tuple[dict[str, CameraEntry], list[str]]:
    """Cameras by name: K, dist (or D), H, W from intri; Rot, R (Rodrigues), T from extri.

    Convention: metres; world to camera. The two files list names in different orders and with
    "none" entries, so cameras are paired by name alone. Without H and W the size is (0, 0).

    Raises:
        DataError: when one file or one camera's half is missing, or they contradict each other.
    """
    intri_path, extri_path = _both(path)
    intri, extri = read_storage(intri_path), read_storage(extri_path)
    names, notes = _names(intri), list[str]()
    cameras = {}
    for name in names:
        where, K = f"{intri_path}, camera {name}", intri.matrix(f"K_{name}")
        if K is None:
            raise DataError(
                f"{intri_path} lists the camera {name} but lacks K_{name}; export it again"
            )
        rotation, T = _rotation(extri, extri_path, name), extri.matrix(f"T_{name}")
        if rotation is None or T is None:
            raise DataError(
                f"{extri_path} lacks Rot_{name} (or R_{name}) and T_{name}, but {intri_path} "
                f"lists the camera {name}; calibrate it, or take it out of both"
            )
        dist = intri.matrix(f"dist_{name}")
        if dist is None:
            dist = intri.matrix(f"D_{name}")
        if dist is None:
            notes.append(f"{intri_path} says no lens distortion for {name}: taken as none")
        cameras[name] = make_camera(
            where,
            name,
            K=K,
            R=rotation,
            t=T,
            dist=None if dist is None else _lens(dist),
            size=(_pixels(intri, where, f"H_{name}"), _pixels(intri, where, f"W_{name}")),
            scale=scale or 1.0,
            pixel_centre=pixel_centre,
        )
    return cameras, notes


def _both(path: Path) -> tuple[Path, Path]:
    pair = []
    for own, other in (("intri", "extri"), ("extri", "intri")):
        if own in path.name.lower():
            pair = [path, path.with_name(path.name.replace(own, other))]
            pair = pair if own == "intri" else pair[::-1]
    if not pair:
        raise DataError(f"{path}: expected OpenCV YAML named intri.yml beside extri.yml")
    for file in pair:
        if not file.is_file():
            raise DataError(f"{file} does not exist; intri.yml and extri.yml belong together")
    return pair[0], pair[1]


def _names(intri: Storage) -> list[str]:
    listed = intri.strings("names") or [key[2:] for key in intri.nodes if key.startswith("K_")]
    return [name for name in dict.fromkeys(listed) if name and name != "none"]


def _lens(dist: np.ndarray) -> list[float]:
    """All coefficients but a tail of zeros: thin prisms and tilts (12, 14) are to be refused."""
    values: list[float] = dist.reshape(-1).tolist()
    return values if any(values[MAX_LENS:]) else values[:MAX_LENS]


def _pixels(intri: Storage, where: str, key: str) -> int:
    value = intri.number(key)
    if value is None:
        return 0
    if not np.isfinite(value) or value != int(value):
        raise DataError(f"{where}: '{key}' must be a number of pixels, found {value}")
    return max(0, int(value))


def _rotation(extri: Storage, path: Path, name: str) -> np.ndarray | None:
    matrix, vector = extri.matrix(f"Rot_{name}"), extri.matrix(f"R_{name}")
    if vector is None:
        return matrix
    turned = cv2.Rodrigues(numbers(f"{path}, camera {name}", vector, f"R_{name}", (3,)))[0]
    if matrix is None:
        return turned
    matrix = numbers(f"{path}, camera {name}", matrix, f"Rot_{name}", (3, 3))
    if np.abs(matrix - turned).max() > SAME_ROTATION:
        raise DataError(
            f"{path}, camera {name}: Rot_{name} and R_{name} are different rotations (by "
            f"{np.abs(matrix - turned).max():.3g}); keep the right one"
        )
    return matrix
