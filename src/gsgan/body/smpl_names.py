"""SMPL's and SMPL-X's joints and parts by name. Constants only.

Source: public loaders.
"""

from itertools import product
from typing import Literal, get_args

Parts = Literal["clothes", "cihp", "joints"]

# The 22 joints that SMPL and SMPL-X share.
_BODY = (
    "pelvis",
    "left_hip",
    "right_hip",
    "spine1",
    "left_knee",
    "right_knee",
    "spine2",
    "left_ankle",
    "right_ankle",
    "spine3",
    "left_foot",
    "right_foot",
    "neck",
    "left_collar",
    "right_collar",
    "head",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
)
# SMPL-X's order, not MediaPipe's.
_FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_HAND = tuple(map("".join, product(_FINGERS, "123")))
_HANDS = tuple(map("_".join, product(("left", "right"), _HAND)))
SMPL_JOINTS = (*_BODY, "left_hand", "right_hand")
SMPLX_JOINTS = (*_BODY, "jaw", "left_eye", "right_eye", *_HANDS)

JOINT_NAMES = {"smpl": SMPL_JOINTS, "smplx": SMPLX_JOINTS}

CLOTHES = (
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
"""The parts of the free body, in the same order."""

CIHP = (
    "background",
    "hat",
    "hair",
    "glove",
    "sunglasses",
    "upper_clothes",
    "dress",
    "coat",
    "socks",
    "pants",
    "torso_skin",
    "scarf",
    "skirt",
    "face",
    "left_arm",
    "right_arm",
    "left_leg",
    "right_leg",
    "left_shoe",
    "right_shoe",
)
"""ZJU-MoCap's ``mask_cihp``, ids 0 to 19; it has no hands."""


# The last words of the names of limbs and of clothes on legs, feet and hands.
LIMB_WORDS = ("arm", "hand", "leg", "shoe", "pants", "skirt", "socks", "glove")


def part_names(parts: Parts, joint_names: tuple[str, ...]) -> tuple[str, ...]:
    """Names of a set of parts, background first."""
    if parts == "joints":
        return ("background", *joint_names)
    return CLOTHES if parts == "clothes" else CIHP


def fitting_parts(
    label_names: tuple[str, ...], joint_names: tuple[str, ...]
) -> Parts:
    """The set of parts with these names; the free body's if there is none."""
    parts: Parts
    for parts in get_args(Parts):
        if part_names(parts, joint_names) == label_names:
            return parts
    return "clothes"


def part_of_joint(parts: Parts, joint: str) -> str:
    """The part that vertices moved by a joint usually belong to.

    The body wears a shirt, trousers and shoes; the head is face (a body model has no hairline), the
    shins are legs.

    Args:
        parts: the set of parts.
        joint: a name of `SMPL_JOINTS` or `SMPLX_JOINTS`.
    """
    if parts == "joints":
        return joint

    # The head and the trunk have parts without a side.
    side, _, limb = joint.partition("_")
    if joint in ("neck", "head", "jaw") or limb == "eye":
        return "face_neck" if parts == "clothes" else "face"
    if limb in ("foot", "ankle"):
        return f"{side}_shoe"
    if limb == "knee":
        return f"{side}_leg"
    if limb == "elbow":
        return f"{side}_arm"
    if joint == "pelvis" or limb == "hip":
        return "lower_clothes" if parts == "clothes" else "pants"
    if limb in ("wrist", "hand") or limb[:-1] in _FINGERS:
        return f"{side}_hand" if parts == "clothes" else f"{side}_arm"
    return "upper_clothes"


def group_of_part(name: str) -> str:
    """The group of a part or joint: "left_hand", "right_hand", "face_neck", or "" for any other."""
    if name == "face":
        return "face_neck"
    group = _clothes_of(name)
    return group if group in ("left_hand", "right_hand", "face_neck") else ""


def is_limb(name: str) -> bool:
    """Whether a part or joint is of arms, hands, legs or feet; lower clothes are of legs."""
    part = _clothes_of(name)
    return part == "lower_clothes" or part.rpartition("_")[2] in LIMB_WORDS


def _clothes_of(name: str) -> str:
    """The part of `CLOTHES` of a joint; the name of another part."""
    is_joint = name in SMPL_JOINTS or name in SMPLX_JOINTS
    return part_of_joint("clothes", name) if is_joint else name
