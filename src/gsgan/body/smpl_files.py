"""Reads a model file of the SMPL family as checked arrays.

Source: keys and shapes in public loaders.
"""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.utils.arrays import expect_array
from gsgan.utils.errors import DataError
from gsgan.utils.pickles import read_npz, read_pickle

KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
SMPLX_JOINT_COUNT = 55
WEIGHT_TOLERANCE = 1e-3  # of the sum of a vertex's weights, and of negative weights

Floats = NDArray[np.float64]


def read_arrays(path: Path) -> tuple[dict[str, NDArray[Any]], tuple[int, ...]]:
    """The checked arrays of a .pkl or .npz model file, recognised by content.

    Returns:
        The arrays, float64 and int64, by the names of `gsgan.body.smpl.SkinnedModel`, and the
        parent of each joint.

    Raises:
        DataError: when the file is missing, damaged, holds forbidden classes, lacks an array, or
            an array's shape or values are wrong.
    """
    raw = _raw(path)
    v_template = expect_array(raw, "v_template", (None, 3), path)
    V = len(v_template)
    parents = _parents(expect_array(raw, "kintree_table", (2, None), path), path)
    J = len(parents)
    directions = expect_array(raw, "shapedirs", (V, 3, None), path)
    S = _shape_count(J, directions.shape[-1])
    floats = {
        "v_template": v_template,
        "shapedirs": directions,
        "posedirs": expect_array(raw, "posedirs", (V, 3, 9 * (J - 1)), path),
        "J_regressor": expect_array(raw, "J_regressor", (J, V), path),
        "weights": expect_array(raw, "weights", (V, J), path),
    }
    checked = {name: _finite(array, name, path) for name, array in floats.items()}
    directions = checked["shapedirs"]
    return checked | {
        "shapedirs": directions[..., :S],
        "expression_dirs": directions[..., S:],
        "weights": _weights(checked["weights"], path),
        "faces": _faces(expect_array(raw, "f", (None, 3), path), V, path),
    }, parents


def _raw(path: Path) -> dict[str, Any]:
    content = read_npz(path, KEYS) if zipfile.is_zipfile(path) else read_pickle(path)
    if not isinstance(content, dict):
        raise DataError(f"{path} holds a {type(content).__name__}; expected an SMPL model, a dict")
    missing = [key for key in KEYS if not isinstance(content.get(key), np.ndarray)]
    if missing:
        raise DataError(
            f"{path} is not an SMPL model: it has no array {', '.join(missing)}; give the model "
            "file itself (.pkl or .npz), not fitted parameters"
        )
    return content


def _shape_count(joints: int, directions: int) -> int:
    """Number of a file's directions that are body shape; the rest are expression.

    SMPL-X concatenates them: 300 + 100, or 10 + 10.
    """
    if joints == SMPLX_JOINT_COUNT and directions >= 400:
        return 300
    return 10 if joints == SMPLX_JOINT_COUNT and directions == 20 else directions


def _parents(table: NDArray[Any], path: Path) -> tuple[int, ...]:
    """Parent of each joint from the kinematic tree (row 0 the parents, row 1 the joints)."""
    column = {int(joint): place for place, joint in enumerate(table[1])}
    parents = [-1, *(column.get(int(parent), -1) for parent in table[0, 1:])]
    broken = [j for j, parent in enumerate(parents) if j and not 0 <= parent < j]
    found = f"no earlier parent for joint {broken[0]}" if broken else None
    if len(column) != table.shape[1] or len(column) < 2:
        found = f"{len(column)} joints in {table.shape[1]} columns"
    if found:
        raise DataError(
            f"{path}: 'kintree_table' must name every joint once, its parent before it; "
            f"found {found}"
        )
    return tuple(parents)


def _finite(array: NDArray[Any], name: str, path: Path) -> Floats:
    values = np.ascontiguousarray(array, np.float64)
    if not np.isfinite(values).all():
        raise DataError(f"{path}: '{name}' must hold finite numbers, found NaN or infinity")
    return values


def _weights(weights: Floats, path: Path) -> Floats:
    off = np.maximum(np.abs(weights.sum(axis=1) - 1), -weights.min(axis=1, initial=0))
    if (off > WEIGHT_TOLERANCE).any():
        vertex = int(off.argmax())
        raise DataError(
            f"{path}: 'weights' must be positive and sum to 1 for each vertex; those of vertex "
            f"{vertex} sum to {weights[vertex].sum():.4g}"
        )
    return weights.clip(min=0)


def _faces(faces: NDArray[Any], vertices: int, path: Path) -> NDArray[np.int64]:
    indices = faces.astype(np.int64)
    if indices.min(initial=0) < 0 or indices.max(initial=0) >= vertices:
        raise DataError(
            f"{path}: 'f' must hold vertex numbers below {vertices}, found "
            f"{int(indices.min())} to {int(indices.max())}"
        )
    return indices
