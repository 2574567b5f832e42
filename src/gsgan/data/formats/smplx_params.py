"""SMPL-X parameters of a whole sequence in one npz, as in THuman4.0 and AvatarReX.

Convention: metres, axis-angle; row i is frame i; the first row of betas is the subject's. Hands are
full rotations away from the flat hand (``use_pca=False, flat_hand_mean=True`` in smplx's terms).
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.body.smpl import SkinnedModel
from gsgan.data.checks import spans
from gsgan.data.formats.smpl_motion import Motion
from gsgan.utils.arrays import as_floats
from gsgan.utils.errors import DataError
from gsgan.utils.pickles import read_npz

Float = NDArray[np.float64]

# In the order of SMPL-X's joints: numbers per frame of each.
POSES = {
    "global_orient": 3,
    "body_pose": 63,
    "jaw_pose": 3,
    "leye_pose": 3,
    "reye_pose": 3,
    "left_hand_pose": 45,
    "right_hand_pose": 45,
}
NEEDED = ("global_orient", "body_pose", "transl", "betas")
HANDS = ("left_hand_pose", "right_hand_pose")
SMPL_BODY = 69


def read_motion(
    path: Path, frames: Collection[int], model: SkinnedModel, notes: list[str]
) -> Motion:
    """The parameters of the frames that have any, in the model's own convention.

    Args:
        path: smpl_params.npz.
        frames: that have images.
        model: SMPL-X.
        notes: gains a sentence for each omission.

    Raises:
        DataError: on a damaged file, a missing or misshapen array, or one of SMPL.
    """
    arrays = read_npz(path, (*POSES, "transl", "betas", "expression"))
    if missing := [key for key in NEEDED if key not in arrays]:
        raise DataError(
            f"{path} has no array {', '.join(missing)}; expected SMPL-X parameters: "
            f"{', '.join(NEEDED)}, ..."
        )
    transl = _rows(arrays, "transl", 3, path)
    count = len(transl)
    theta = np.concatenate([_pose(arrays, key, count, path) for key in POSES], axis=1)
    if absent := [key for key in HANDS if key not in arrays]:
        notes.append(f"{path} has no {' and '.join(absent)}: taken as flat hands")
    betas = _coefficients(arrays, "betas", model.shapedirs.shape[-1], path)[0]
    if not np.isfinite(betas).all():
        raise DataError(f"{path}: 'betas' must hold finite numbers, found NaN or infinity")
    face = np.zeros((count, 0))
    if "expression" in arrays:
        face = _coefficients(arrays, "expression", model.expression_dirs.shape[-1], path)
        _same_count("expression", len(face), count, path)
    ids = _usable(path, frames, np.concatenate([theta, transl, face], axis=1), notes)
    return Motion(
        ids=ids,
        theta=theta.reshape(count, -1, 3)[ids],
        transl=transl[ids],
        betas=np.repeat(betas[None], len(ids), axis=0),
        expression=face[ids],
    )


def _pose(arrays: dict[str, Any], key: str, count: int, path: Path) -> Float:
    """``[count, width]``; zeros where the file has no such array."""
    if key not in arrays:
        return np.zeros((count, POSES[key]))
    rows = _rows(arrays, key, POSES[key], path)
    _same_count(key, len(rows), count, path)
    return rows


def _same_count(key: str, found: int, count: int, path: Path) -> None:
    if found != count:
        raise DataError(
            f"{path}: '{key}' has {found} rows and 'transl' {count}; expected one per frame in both"
        )


def _rows(arrays: dict[str, Any], key: str, width: int | None, path: Path) -> Float:
    """``[N, width]`` of an array ``[N, ...]``."""
    raw = arrays[key]
    values = as_floats(raw)
    values = (
        values.reshape(len(values), -1) if values.ndim > 1 and values.size else np.zeros((0, 0))
    )
    if not values.size or width not in (None, values.shape[1]):
        raise DataError(f"{path}: {_expectation(key, width, values.shape[1], raw)}")
    return values


def _expectation(key: str, width: int | None, found: int, raw: Any) -> str:
    if key == "body_pose" and found == SMPL_BODY:
        return (
            f"'body_pose' has {SMPL_BODY} numbers per frame, those of SMPL; expected SMPL-X's "
            f"{width} (21 joints): fit SMPL-X to the sequence, or use its own smpl_params.npz"
        )
    expected = f"(frames, {width or 'any'})"
    shape = getattr(raw, "shape", type(raw).__name__)
    if key in HANDS and 0 < found < POSES[key]:
        return (
            f"'{key}' has {found} numbers per frame, which look like PCA coefficients; expected "
            f"{width} (15 joints, use_pca=False)"
        )
    return f"'{key}' must hold numbers of shape {expected}, found {shape}"


def _coefficients(arrays: dict[str, Any], key: str, most: int, path: Path) -> Float:
    """``[N, n]``, n at most the model's number; further ones must be 0."""
    values = _rows(arrays, key, None, path)
    if np.any(values[:, most:] != 0):
        raise DataError(
            f"{path}: '{key}' has {values.shape[1]} coefficients, the model file {most}; give the "
            "SMPL-X file with all of them as data.smpl"
        )
    return values[:, :most]


def _usable(
    path: Path, frames: Collection[int], values: Float, notes: list[str]
) -> NDArray[np.int64]:
    """Rising numbers of the frames that have images and finite numbers."""
    there = [f for f in sorted(frames) if f < len(values)]
    ids = np.array([f for f in there if np.isfinite(values[f]).all()], np.int64)
    if not len(ids):
        raise DataError(
            f"{path} has {len(values)} rows, but no finite one of a frame that has images; "
            "expected row i to be frame i"
        )
    if lost := sorted(set(there) - set(ids.tolist())):
        notes.append(f"{path}: NaN or infinity at frames {spans(lost)}")
    return ids
