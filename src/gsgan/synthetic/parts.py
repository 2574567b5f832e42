"""Part labels of a character's faces, from names, bones and colours."""

import re
from typing import cast

import cv2
import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.graph import connected_component_labels

from gsgan.motion.character import Character, Ints
from gsgan.motion.rotations import Array

LABEL_NAMES = (
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
LABEL = {name: k for k, name in enumerate(LABEL_NAMES)}
HAIR, FACE, UPPER, LOWER = (LABEL[k] for k in LABEL_NAMES[1:5])
SHOES = LABEL["left_shoe"], LABEL["right_shoe"]
# A bone, and all below it without an entry: the label of cloth there, and of bare skin there.
OF_BONE = {
    "Hips": ("lower_clothes", "lower_clothes"),
    "Spine": ("upper_clothes", "face_neck"),
    "Neck": ("upper_clothes", "face_neck"),
    "Head": ("face_neck", "face_neck"),
    "Arm": ("upper_clothes", "{}_arm"),
    "Hand": ("{}_hand", "{}_hand"),
    "UpLeg": ("lower_clothes", "{}_leg"),
    "Foot": ("{}_shoe", "{}_shoe"),
}
# Beginnings of words in names of materials and meshes; "skin" takes the bones' label of skin.
WORDS = {
    "hair": "hair bang ponytail headwear hat helmet",
    "face_neck": "head face eye brow lash teeth tooth tongue mouth beard gland glasses",
    "left_shoe": "shoe boot sneaker footwear sandal",
    "lower_clothes": "pants trouser jeans skirt shorts bottom",
    "upper_clothes": "shirt tshirt top jacket coat hoodie sweater blouse dress onepiece vest",
    "skin": "skin",
}
# CIELAB, lightness counted half: below it a face has the skin's colour
SKIN_DISTANCE = 22.0
HAIR_DISTANCE = 12.0  # a crown nearer to the skin's colour is a bald one
GARMENT_DISTANCE = 8.0  # garments nearer in colour are told apart by bones
TRUNK = ("Spine1", "Spine2", "LeftArm", "RightArm")
SHANKS = ("LeftLeg", "RightLeg")
BETWEEN = ("Hips", "Spine", "LeftUpLeg", "RightUpLeg")
CHEST = 0.16  # metres below the shoulders: skin above is the neck's, below the trunk's


def face_labels(character: Character, names: np.ndarray) -> Ints:
    """``[F]`` the part of each face, at least 1.

    A material or mesh named after a part or a garment decides. Elsewhere bones decide which limb a
    face is on, and its colour whether it is skin, hair or cloth; pieces of cloth (connected
    vertices) are then upper or lower clothes or a shoe as a whole.

    Args:
        character: its ``labels`` are not read.
        names: ``[F]`` name of each face's mesh.
    """
    c = character
    corner = c.faces[:, 0]
    bone = c.dominant_bones()[corner]
    cloth, skin, root = (rows[bone] for rows in _bone_labels(c))
    lab = _lab(c)
    corners = c.vertices[c.faces]
    centre = corners.mean(1)
    area = trimesh.triangles.area(corners)
    shoulders = c.joints[_numbers(c, ("LeftArm", "RightArm")), 2].min()
    low = (skin == FACE) & (root == "Spine") & (centre[:, 2] < shoulders - CHEST)
    skin = np.where(low, UPPER, skin)

    head = root == "Head"
    neck = c.joints[c.bones.index("Head"), 2]
    cheeks = float(neck + 0.35 * (c.vertices[:, 2].max() - neck))
    front = (
        head & (c.normals[corner, 1] < -0.6) & (np.abs(centre[:, 2] - cheeks) < 0.05)
    )
    tone = np.median(lab[front] if front.any() else lab, 0)
    bare = _voted(c, np.linalg.norm(lab - tone, axis=1) < SKIN_DISTANCE)
    labels = np.where(bare, skin, cloth)
    upper = _tone(lab, ~bare & np.isin(bone, _numbers(c, TRUNK)), tone)
    lower = _tone(lab, ~bare & np.isin(bone, _numbers(c, SHANKS)), tone)
    if np.linalg.norm(upper - lower) > GARMENT_DISTANCE:
        nearer = np.linalg.norm(lab - upper, axis=1) < np.linalg.norm(
            lab - lower, axis=1
        )
        between = ~bare & np.isin(bone, _numbers(c, BETWEEN))
        labels = np.where(between, np.where(_voted(c, nearer), UPPER, LOWER), labels)

    named = _named(c, names)
    right = np.array([name.startswith("Right") for name in c.bones])[bone]
    shoes = np.where(right, *SHOES[::-1])
    choices = [named == SHOES[0], named > 0, named < 0]
    labels = np.select(choices, [shoes, named, skin], labels)
    if not (named == HAIR).any():
        near = (head | (root == "Neck")) & (named == 0)
        labels = np.where(
            _hair(c, lab, np.array([tone, upper]), near, centre), HAIR, labels
        )
    return _whole_garments(c, labels, shoes, named == 0, area)


def _numbers(c: Character, bones: tuple[str, ...]) -> list[int]:
    return [c.bones.index(bone) for bone in bones if bone in c.bones]


def _tone(lab: Array, at: np.ndarray, default: Array) -> Array:
    return cast(Array, np.median(lab[at], 0)) if at.any() else default


def _bone_labels(c: Character) -> tuple[Ints, Ints, np.ndarray]:
    """``[J]`` labels of cloth and of skin on each bone, and the bone of ``OF_BONE`` it is below."""
    rows: list[tuple[int, int, str]] = []
    for bone, parent in zip(c.bones, c.parents, strict=True):
        side = next((s for s in ("Left", "Right") if bone.startswith(s)), "")
        entry = OF_BONE.get(bone[len(side) :])
        if entry:
            cloth, skin = (LABEL[name.format(side.lower())] for name in entry)
            rows.append((cloth, skin, bone[len(side) :]))
        else:
            rows.append(rows[parent] if parent >= 0 else (LOWER, LOWER, "Hips"))
    labels = np.array([row[:2] for row in rows])
    return labels[:, 0], labels[:, 1], np.array([row[2] for row in rows])


def _named(c: Character, names: np.ndarray) -> Ints:
    """``[F]`` the label in the name of the material, else of the mesh; -1 for skin, 0 for none."""
    found = np.array([_label_of(surface.name) for surface in c.surfaces])[c.material]
    of_mesh = {name: _label_of(name) for name in np.unique(names)}
    return np.where(found != 0, found, np.array([of_mesh[name] for name in names]))


def _label_of(name: str) -> int:
    if name in LABEL:
        return LABEL[name]
    words = [word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)]
    for label, stems in WORDS.items():
        if any(word.startswith(tuple(stems.split())) for word in words):
            return LABEL.get(label, -1)
    return 0


def texture_lab(c: Character, uv: Array, material: Ints) -> Array:
    """``[N, 3]`` CIELAB colours of the materials ``[N]`` at texture coordinates ``[N, 2]``."""
    colour = np.zeros((len(uv), 3))
    for m, surface in enumerate(c.surfaces):
        at = material == m
        h, w = surface.colour.shape[:2]
        x, y = np.minimum(uv[at] % 1 * (w, h), (w - 1, h - 1)).astype(int).T
        colour[at] = surface.colour[y, x, :3] / 255
    lab = cv2.cvtColor(colour[:, None].astype(np.float32), cv2.COLOR_RGB2LAB)[:, 0]
    return lab.astype(np.float64)


def _lab(c: Character) -> Array:
    """``[F, 3]`` CIELAB colour of each face, lightness halved: the mean of four points."""
    points = np.vstack([np.full((1, 3), 1 / 3), 0.2 + 0.4 * np.eye(3)])
    uv = np.einsum("pk,fkd->pfd", points, c.uv[c.faces])
    lab = np.mean([texture_lab(c, at, c.material) for at in uv], 0)
    return lab * np.array([0.5, 1, 1])


def _neighbours(c: Character) -> Ints:
    """``[E, 2]`` pairs of faces with a common edge, vertices at one place taken as one."""
    _, place = np.unique(np.round(c.vertices, 5), axis=0, return_inverse=True)
    return trimesh.graph.face_adjacency(faces=place.reshape(-1)[c.faces])


def _voted(c: Character, flag: np.ndarray, rounds: int = 4) -> np.ndarray:
    """A flag of faces without its specks: the majority of each face and its neighbours."""
    pairs = _neighbours(c)
    for _ in range(rounds):
        votes = 2.0 * flag - 1
        total = votes.copy()
        np.add.at(total, pairs[:, 0], votes[pairs[:, 1]])
        np.add.at(total, pairs[:, 1], votes[pairs[:, 0]])
        flag = total > 0
    return flag


def _hair(
    c: Character, lab: Array, others: Array, near: np.ndarray, centre: Array
) -> np.ndarray:
    """Faces of the scalp's hair: nearer to the crown's colours than to others, connected."""
    head = c.joints[c.bones.index("Head"), 2]
    crown = near & (centre[:, 2] > head + 0.8 * (c.vertices[:, 2].max() - head))
    far = np.linalg.norm(lab[crown] - others[0], axis=1)
    if not crown.any() or np.median(far) < HAIR_DISTANCE:
        return np.zeros_like(crown)
    palette = lab[crown][far > HAIR_DISTANCE]  # strands and highlights
    to_hair, _ = cKDTree(palette[:: max(1, len(palette) // 64)]).query(lab)
    to_others, _ = cKDTree(others).query(lab)
    like = _voted(c, (near & (to_hair < to_others)) | crown, 2) & near
    pairs = _neighbours(c)
    parts = connected_component_labels(pairs[like[pairs].all(1)], len(like))
    hair = like & np.isin(parts, np.unique(parts[crown & like]))
    # small islands within the hair are hair: highlights, and shadows of strands
    rest = connected_component_labels(pairs[~hair[pairs].any(1)], len(like))
    edge = pairs[hair[pairs].sum(1) == 1]
    touching = np.unique(rest[edge[~hair[edge]]])
    sizes = np.bincount(rest[~hair], minlength=rest.max() + 1)
    small = touching[sizes[touching] < 0.1 * hair.sum()]
    return hair | (~hair & np.isin(rest, small) & near)


def _whole_garments(
    c: Character, labels: Ints, shoes: Ints, free: np.ndarray, area: Array
) -> Ints:
    """Each piece of cloth gets the label of most of its area."""
    edges = np.concatenate([c.faces[:, [0, 1]], c.faces[:, [1, 2]]])
    piece = connected_component_labels(edges, len(c.vertices))[c.faces[:, 0]]
    kind = np.select(
        [labels == UPPER, labels == LOWER, np.isin(labels, SHOES)], [0, 1, 2], -1
    )
    cloth = (kind >= 0) & free
    total = np.zeros((piece.max() + 1, 3))
    np.add.at(total, (piece[cloth], kind[cloth]), area[cloth])
    share = total / np.maximum(total.sum(1, keepdims=True), 1e-12)
    winner = np.where(share.max(1) > 0.85, share.argmax(1), -1)[piece]
    changed = cloth & (winner >= 0) & (winner != kind)
    return np.where(
        changed, np.choose(np.maximum(winner, 0), [UPPER, LOWER, shoes]), labels
    )
