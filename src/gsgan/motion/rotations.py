"""Rotations and directions as NumPy arrays, batched over leading dimensions."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]


def unit(v: Array) -> Array:
    """Vectors ``[..., 3]`` divided by their length."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.maximum(length, 1e-12)


def rotation(axis_angle: Array) -> Array:
    """Rotation matrices ``[..., 3, 3]`` of axis-angle vectors ``[..., 3]``, radians."""
    R = Rotation.from_rotvec(axis_angle.reshape(-1, 3)).as_matrix()
    return R.reshape(*axis_angle.shape[:-1], 3, 3)


def matvec(R: Array, v: Array) -> Array:
    """Vectors ``[..., 3]``, each multiplied by its own matrix ``[..., 3, 3]``."""
    return (R @ v[..., None])[..., 0]


def axis_angle(R: Array) -> Array:
    """Axis-angle vectors ``[..., 3]`` of rotation matrices ``[..., 3, 3]``, radians."""
    vectors = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec()
    return vectors.reshape(*R.shape[:-2], 3)


def between(a: Array, b: Array) -> Array:
    """Smallest rotations ``[..., 3, 3]`` that take directions ``a`` to directions ``b``."""
    a = unit(a)
    b = unit(b)

    # About the normal of both, by the angle between them.
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis, axis=-1)
    cosine = (a * b).sum(-1)
    angle = np.arctan2(sine, cosine)
    return rotation(unit(axis) * angle[..., None])


def blend(a: Array, b: Array, share: float | Array) -> Array:
    """Rotations on the shortest way from ``a`` to ``b``."""
    way = axis_angle(a.mT @ b)
    return a @ rotation(share * way)


def twist(R: Array, axis: int) -> Array:
    """Angle ``[...]`` in [-π, π] of rotations about a coordinate axis, without their swing."""
    q = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat()
    q = q.reshape(*R.shape[:-2], 4)

    # q and -q are the same rotation; w >= 0 gives the smaller angle.
    q = q * np.where(q[..., 3:] < 0, -1, 1)
    return np.asarray(2 * np.arctan2(q[..., axis], q[..., 3]))
