"""Samples the random surface points of src/gsgan/skeleton/templates.npz.

    python scripts/make_skeleton_templates.py [output.npz]

Deterministic for one trimesh version; the file is part of the package, so that results do not
depend on the version.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh
from trimesh.sample import sample_surface

from gsgan.skeleton.template import MEDIAPIPE33

LIMB_POINTS, FACE_POINTS, TORSO_POINTS = 200, 500, 500
OUTPUT = (
    Path(__file__).parents[1] / "src" / "gsgan" / "skeleton" / "templates.npz"
)


def make_templates() -> dict[str, np.ndarray]:
    """Points and normals of the unit shapes, float32; see gsgan.skeleton.densify."""
    return {
        **_named("cylinder", *_cylinder(LIMB_POINTS, seed=100)),
        **_named("sphere", *_sphere(FACE_POINTS, seed=0)),
        **_named("box", *_box(TORSO_POINTS, (1.0, 1.0, 1.0), seed=1)),
        **_named(
            "box_fit", *_box(TORSO_POINTS, MEDIAPIPE33.rest_torso, seed=1)
        ),
    }


def _named(
    name: str, points: np.ndarray, normals: np.ndarray
) -> dict[str, np.ndarray]:
    return {
        name: points.astype(np.float32),
        f"{name}_normals": normals.astype(np.float32),
    }


def _cylinder(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.cylinder(radius=1.0, height=1.0, sections=64)
    # a limb's caps are inside its neighbours: sample the lateral faces only
    lateral = np.abs(mesh.face_normals[:, 2]) < 0.5
    points, _ = sample_surface(
        mesh, n, face_weight=mesh.area_faces * lateral, seed=seed
    )
    normals = points * [1.0, 1.0, 0.0]
    # off the facets, onto the cylinder
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals + np.outer(points[:, 2] + 0.5, [0.0, 0.0, 1.0]), normals


def _sphere(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    points, _ = sample_surface(
        trimesh.creation.icosphere(subdivisions=4), n, seed=seed
    )
    points = points / np.linalg.norm(points, axis=1, keepdims=True)
    return points, points


def _box(
    n: int, extents: tuple[float, float, float], seed: int
) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.box(extents=extents)
    points, faces = sample_surface(mesh, n, seed=seed)
    return points / extents, mesh.face_normals[faces]


if __name__ == "__main__":
    output = Path(sys.argv[1]) if len(sys.argv) > 1 else OUTPUT
    np.savez_compressed(output, **make_templates())
    print(f"wrote {output}")
