"""Part labels of a character's faces, from names and bones."""

import re

import numpy as np

from gsgan.motion.character import Character, Ints

LABEL_NAMES = ("background", "hair", "face_neck", "upper_clothes", "lower_clothes", "left_arm",
               "right_arm", "left_hand", "right_hand", "left_leg", "right_leg", "left_shoe",
               "right_shoe")  # fmt: skip
LABEL = {name: k for k, name in enumerate(LABEL_NAMES)}
SHOES = LABEL["left_shoe"], LABEL["right_shoe"]
# A bone, and all below it without an entry: the label of cloth there, and of bare skin there.
OF_BONE = {
    "Hips": ("lower_clothes", "lower_clothes"),
    "Spine": ("upper_clothes", "upper_clothes"),
    "Neck": ("face_neck", "face_neck"),
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


def face_labels(c: Character, names: np.ndarray) -> Ints:
    """``[F]`` the part of each face, at least 1.

    A material or mesh named after a part or a garment decides, elsewhere the face's bone.

    Args:
        c: its ``labels`` are not read.
        names: ``[F]`` name of each face's mesh.
    """
    bone = c.dominant_bones()[c.faces[:, 0]]
    rows: list[tuple[int, int]] = []
    for name, parent in zip(c.bones, c.parents, strict=True):
        side = next((s for s in ("Left", "Right") if name.startswith(s)), "")
        if entry := OF_BONE.get(name[len(side) :]):
            rows.append(
                (LABEL[entry[0].format(side.lower())], LABEL[entry[1].format(side.lower())])
            )
        else:
            rows.append(rows[parent] if parent >= 0 else (LABEL["lower_clothes"],) * 2)
    cloth, skin = np.array(rows)[bone].T
    named = _named(c, names)
    right = np.array([name.startswith("Right") for name in c.bones])[bone]
    choices = [named == SHOES[0], named > 0, named < 0]
    return np.select(choices, [np.where(right, *SHOES[::-1]), named, skin], cloth)


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
