"""Sample points on unit shapes, in the shape's own frame.

Convention: float64 numpy arrays ``points [n, 3]`` and outward unit ``normals [n, 3]``. The
cylinder has radius 1 and height 1 from z = 0 up, lateral face only (caps would be inside the
neighbouring limb); the sphere has radius 1; the box has edges of 1 around the origin.
"""

from __future__ import annotations

from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

Samples = tuple[NDArray[np.float64], NDArray[np.float64]]

GOLDEN = (5**0.5 - 1) / 2
PLASTIC = 1.32471795724474602596  # root of x³ = x + 1, the two-dimensional golden ratio


def even_cylinder(n: int) -> Samples:
    """``n`` points on the unit cylinder: evenly spaced in height, a golden angle apart."""
    k = np.arange(n)
    turn = 2 * np.pi * np.modf(k * GOLDEN)[0]
    normals = np.stack([np.cos(turn), np.sin(turn), np.zeros(n)], axis=-1)
    return normals + np.outer((k + 0.5) / n, [0.0, 0.0, 1.0]), normals


def even_sphere(n: int) -> Samples:
    """``n`` points of the Fibonacci lattice on the unit sphere."""
    k = np.arange(n)
    z = 1 - (2 * k + 1) / n
    turn = 2 * np.pi * np.modf(k * GOLDEN)[0]
    ring = np.sqrt(1 - z * z)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1)
    return points, points.copy()


def even_box(n: int, extents: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Samples:
    """``n`` points on the unit box, per face in proportion to its area when scaled to ``extents``.

    Faces are filled by the R2 sequence (Roberts 2018), a two-dimensional golden ratio.
    """
    x, y, z = extents
    areas = np.array([y * z, y * z, z * x, z * x, x * y, x * y])
    counts = np.diff(np.round(np.cumsum(np.append(0.0, areas)) / areas.sum() * n).astype(int))
    points, normals = [], []
    for face, count in enumerate(counts):
        axis, sign = face // 2, 1.0 - 2.0 * (face % 2)
        k = np.arange(count)[:, None] + 1
        flat = np.modf(0.5 + k / PLASTIC ** np.array([1, 2]))[0] - 0.5
        points.append(np.insert(flat, axis, 0.5 * sign, axis=1))
        normals.append(np.tile(np.eye(3)[axis] * sign, (count, 1)))
    return np.concatenate(points), np.concatenate(normals)


def shipped(shape: str, n: int) -> Samples:
    """The stored random samples of a shape: cylinder, sphere, box, or box_fit.

    ``templates.npz`` was sampled once with trimesh (scripts/make_skeleton_templates.py), so that
    results do not depend on the trimesh version.

    Raises:
        ValueError: when the file holds another number of points than ``n``.
    """
    with (files("gsgan.skeleton") / "templates.npz").open("rb") as file:
        stored = np.load(file, allow_pickle=False)
        points, normals = stored[shape].astype(np.float64), stored[f"{shape}_normals"]
    if len(points) != n:
        raise ValueError(
            f"sampler 'trimesh' has {len(points)} {shape} points, {n} were requested; "
            "use sampler 'even' for other numbers"
        )
    return points, normals.astype(np.float64)
