"""Part labels of a character's faces, from names, bones and colours."""

from __future__ import annotations

import numpy as np

from gsgan.data.synthetic.character import Character, Ints

LABEL_NAMES = ("background", "hair", "face_neck", "upper_clothes", "lower_clothes", "left_arm",
               "right_arm", "left_hand", "right_hand", "left_leg", "right_leg", "left_shoe",
               "right_shoe")  # fmt: skip
# The label that a bone, and all bones below it without an entry, gives to its faces.
OF_BONE = {"Hips": "lower_clothes", "Spine": "upper_clothes", "Neck": "face_neck",
           "Head": "face_neck", "UpLeg": "lower_clothes", "Arm": "upper_clothes",
           "ForeArm": "{}_arm", "Hand": "{}_hand", "Foot": "{}_shoe"}  # fmt: skip


def bone_labels(character: Character) -> Ints:
    """``[J]`` the label of each bone: its own or that of the nearest bone above."""
    labels: list[int] = []
    for bone, parent in zip(character.bones, character.parents, strict=True):
        side = next((s for s in ("Left", "Right") if bone.startswith(s)), "")
        name = OF_BONE.get(bone[len(side) :])
        inherited = labels[parent] if parent >= 0 else LABEL_NAMES.index("lower_clothes")
        labels.append(LABEL_NAMES.index(name.format(side.lower())) if name else inherited)
    return np.array(labels)


def face_labels(character: Character, names: np.ndarray) -> Ints:
    """``[F]`` the label of each face; ``names [F]`` are those of its mesh."""
    main = np.take_along_axis(
        character.bone_index, character.bone_weight.argmax(1)[:, None], 1
    )[:, 0]
    return bone_labels(character)[main[character.faces[:, 0]]]
