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
from gsgan.synthetic.textures import linear, srgb

# The names of the free body's parts, in the same order.
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
HAIR = LABEL["hair"]
FACE_NECK = LABEL["face_neck"]
UPPER = LABEL["upper_clothes"]
LOWER = LABEL["lower_clothes"]
LEFT_SHOE = LABEL["left_shoe"]
RIGHT_SHOE = LABEL["right_shoe"]
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
# Distances in CIELAB, lightness counted half.
SKIN_DISTANCE = 22.0  # faces nearer to the skin's colour are skin
HAIR_DISTANCE = 12.0  # a crown nearer to the skin's colour is a bald one
GARMENT_DISTANCE = 8.0  # garments nearer in colour are told apart by bones
SHIRT_BONES = ("Spine1", "Spine2", "LeftArm", "RightArm")
TROUSER_BONES = ("LeftLeg", "RightLeg")
WAIST_BONES = ("Hips", "Spine", "LeftUpLeg", "RightUpLeg")
# Metres below the shoulders: skin above is the neck's, below the trunk's.
NECK_SKIN_DEPTH = 0.16


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
    corners = c.vertices[c.faces]
    centre = corners.mean(axis=1)
    lab = _lab(c)

    # The labels of cloth and of skin that the bones give. Skin below the neck is the trunk's.
    cloth_of, skin_of, root_of = _bone_labels(c)
    cloth = cloth_of[bone]
    skin = skin_of[bone]
    root = root_of[bone]
    shoulders = c.joints[_numbers(c, ("LeftArm", "RightArm")), 2].min()
    chest = (
        (skin == FACE_NECK)
        & (root == "Spine")
        & (centre[:, 2] < shoulders - NECK_SKIN_DEPTH)
    )
    skin = np.where(chest, UPPER, skin)

    # Skin has the colour of the cheeks.
    head = root == "Head"
    neck = c.joints[c.bones.index("Head"), 2]
    cheeks = float(neck + 0.35 * (c.vertices[:, 2].max() - neck))
    level = np.abs(centre[:, 2] - cheeks) < 0.05
    front = head & (c.normals[corner, 1] < -0.6) & level
    tone = np.median(lab[front] if front.any() else lab, axis=0)
    bare = _vote(c, np.linalg.norm(lab - tone, axis=1) < SKIN_DISTANCE)
    labels = np.where(bare, skin, cloth)

    # Between shirt and trousers, the nearer colour decides, if they differ.
    upper = _tone(lab, ~bare & np.isin(bone, _numbers(c, SHIRT_BONES)), tone)
    lower = _tone(lab, ~bare & np.isin(bone, _numbers(c, TROUSER_BONES)), tone)
    if np.linalg.norm(upper - lower) > GARMENT_DISTANCE:
        to_upper = np.linalg.norm(lab - upper, axis=1)
        to_lower = np.linalg.norm(lab - lower, axis=1)
        garment = np.where(_vote(c, to_upper < to_lower), UPPER, LOWER)
        waist = ~bare & np.isin(bone, _numbers(c, WAIST_BONES))
        labels = np.where(waist, garment, labels)

    # Names of materials and meshes take precedence.
    named = _find_names(c, names)
    right = np.array([name.startswith("Right") for name in c.bones])[bone]
    shoes = np.where(right, RIGHT_SHOE, LEFT_SHOE)
    choices = [named == LEFT_SHOE, named > 0, named < 0]
    labels = np.select(choices, [shoes, named, skin], labels)

    # Hair without a name is found by its colour.
    if not (named == HAIR).any():
        near = (head | (root == "Neck")) & (named == 0)
        hair = _hair(c, lab, np.array([tone, upper]), near, centre)
        labels = np.where(hair, HAIR, labels)
    area = trimesh.triangles.area(corners)
    return _whole_garments(c, labels, shoes, named == 0, area)


def _numbers(c: Character, bones: tuple[str, ...]) -> list[int]:
    return [c.bones.index(bone) for bone in bones if bone in c.bones]


def _tone(lab: Array, at: np.ndarray, default: Array) -> Array:
    """Median colour of some faces."""
    return cast(Array, np.median(lab[at], axis=0)) if at.any() else default


def _bone_labels(c: Character) -> tuple[Ints, Ints, np.ndarray]:
    """``[J]`` labels of cloth and of skin on each bone, and the bone of ``OF_BONE`` it is below."""
    cloth: list[int] = []
    skin: list[int] = []
    roots: list[str] = []

    # Bones without labels of their own have those of their parents, and roots those of the hips.
    for bone, parent in zip(c.bones, c.parents, strict=True):
        name = bone.removeprefix("Left").removeprefix("Right")
        side = bone.removesuffix(name).lower()
        if name in OF_BONE:
            of_cloth, of_skin = OF_BONE[name]
            cloth.append(LABEL[of_cloth.format(side)])
            skin.append(LABEL[of_skin.format(side)])
            roots.append(name)
        elif parent >= 0:
            cloth.append(cloth[parent])
            skin.append(skin[parent])
            roots.append(roots[parent])
        else:
            cloth.append(LOWER)
            skin.append(LOWER)
            roots.append("Hips")
    return np.array(cloth), np.array(skin), np.array(roots)


def _find_names(c: Character, names: np.ndarray) -> Ints:
    """``[F]`` the label in the name of the material, else of the mesh; -1 for skin, 0 for none."""
    labels = np.array([_label_of(surface.name) for surface in c.surfaces])[
        c.material
    ]
    distinct, which = np.unique(names, return_inverse=True)
    of_mesh = np.array([_label_of(name) for name in distinct])[which]
    return np.where(labels != 0, labels, of_mesh)


def _label_of(name: str) -> int:
    """The label that a name contains; -1 for skin, 0 for none."""
    if name in LABEL:
        return LABEL[name]
    words = [
        word.lower()
        for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)
    ]
    for label, stems in WORDS.items():
        beginnings = tuple(stems.split())
        if any(word.startswith(beginnings) for word in words):
            return LABEL.get(label, -1)
    return 0


def texture_lab(
    c: Character, uv: Array, material: Ints, tint: Array | None
) -> Array:
    """``[N, 3]`` CIELAB colours of the materials ``[N]`` at texture coordinates ``[N, 2]``, with
    factors ``tint [N, 4]`` of linear colour."""
    colour = np.zeros((len(uv), 3))
    for m, surface in enumerate(c.surfaces):
        at = material == m
        h, w = surface.colour.shape[:2]
        texel = np.minimum(uv[at] % 1 * (w, h), (w - 1, h - 1)).astype(int)
        colour[at] = surface.colour[texel[:, 1], texel[:, 0], :3] / 255
    if tint is not None:
        colour[:] = srgb(linear(colour) * tint[:, :3])
    lab = cv2.cvtColor(colour[:, None].astype(np.float32), cv2.COLOR_RGB2LAB)[
        :, 0
    ]
    return lab.astype(np.float64)


def _lab(c: Character) -> Array:
    """``[F, 3]`` CIELAB colour of each face, lightness halved: the mean of four points."""
    # Barycentric weights of the middle and of a point near each corner.
    points = np.vstack([np.full((1, 3), 1 / 3), 0.2 + 0.4 * np.eye(3)])
    uv = np.einsum("pk,fkd->pfd", points, c.uv[c.faces])
    tint: Array | list[None] = [None] * len(points)
    if c.tint is not None:
        tint = np.einsum("pk,fkd->pfd", points, c.tint[c.faces])
    each = zip(uv, tint, strict=True)
    lab = np.mean([texture_lab(c, at, c.material, by) for at, by in each], 0)
    return lab * np.array([0.5, 1, 1])


def _neighbours(c: Character) -> Ints:
    """``[E, 2]`` pairs of faces with a common edge, vertices at one place taken as one."""
    # The number of each vertex's place.
    _, place = np.unique(np.round(c.vertices, 5), axis=0, return_inverse=True)
    return trimesh.graph.face_adjacency(faces=place.reshape(-1)[c.faces])


def _vote(c: Character, flag: np.ndarray, rounds: int = 4) -> np.ndarray:
    """A flag of faces without its specks: the majority of each face and its neighbours."""
    # A face votes for itself and for its neighbours.
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
    # The crown tells the colours of the hair: strands and highlights.
    head = c.joints[c.bones.index("Head"), 2]
    crown = near & (centre[:, 2] > head + 0.8 * (c.vertices[:, 2].max() - head))
    far = np.linalg.norm(lab[crown] - others[0], axis=1)
    if not crown.any() or np.median(far) < HAIR_DISTANCE:
        return np.zeros_like(crown)
    palette = lab[crown][far > HAIR_DISTANCE]
    palette = palette[:: max(1, len(palette) // 64)]

    # Faces with such colours that are connected to the crown.
    to_hair, _ = cKDTree(palette).query(lab)
    to_others, _ = cKDTree(others).query(lab)
    like = _vote(c, (near & (to_hair < to_others)) | crown, rounds=2) & near
    pairs = _neighbours(c)
    within = pairs[like[pairs].all(axis=1)]
    parts = connected_component_labels(within, len(like))
    hair = like & np.isin(parts, np.unique(parts[crown & like]))

    # Small islands within the hair are hair: highlights, and shadows of strands.
    outside = pairs[~hair[pairs].any(axis=1)]
    rest = connected_component_labels(outside, len(like))
    edge = pairs[hair[pairs].sum(axis=1) == 1]
    touching = np.unique(rest[edge[~hair[edge]]])
    sizes = np.bincount(rest[~hair], minlength=rest.max() + 1)
    small = touching[sizes[touching] < 0.1 * hair.sum()]
    return hair | (~hair & np.isin(rest, small) & near)


def _whole_garments(
    c: Character, labels: Ints, shoes: Ints, free: np.ndarray, area: Array
) -> Ints:
    """Each piece of cloth gets the label of most of its area."""
    # A piece is a set of connected vertices.
    edges = np.concatenate([c.faces[:, [0, 1]], c.faces[:, [1, 2]]])
    piece = connected_component_labels(edges, len(c.vertices))[c.faces[:, 0]]

    # Area of upper clothes (0), lower clothes (1) and shoes (2) on each piece.
    kinds = [
        labels == UPPER,
        labels == LOWER,
        np.isin(labels, (LEFT_SHOE, RIGHT_SHOE)),
    ]
    kind = np.select(kinds, [0, 1, 2], -1)
    cloth = (kind >= 0) & free
    total = np.zeros((piece.max() + 1, 3))
    np.add.at(total, (piece[cloth], kind[cloth]), area[cloth])

    # Pieces without a clear majority stay as they are.
    share = total / np.maximum(total.sum(axis=1, keepdims=True), 1e-12)
    clear = share.max(axis=1) > 0.85
    winner = np.where(clear, share.argmax(axis=1), -1)[piece]
    changed = cloth & (winner >= 0) & (winner != kind)
    new = np.choose(np.maximum(winner, 0), [UPPER, LOWER, shoes])
    return np.where(changed, new, labels)
