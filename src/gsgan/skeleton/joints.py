"""The joints of a capture, 33 + 2 x 21 + 30 of the face, and their numbers in other detectors."""

import numpy as np

from gsgan.skeleton.face import FACE_NAMES
from gsgan.skeleton.hands import HAND, hand_names
from gsgan.skeleton.template import MEDIAPIPE33
from gsgan.utils.arrays import Bool, Float

# All joints in one array: the body, the left hand, the right hand, the face.
BODY = len(MEDIAPIPE33.names)
LEFT = slice(BODY, BODY + HAND)
RIGHT = slice(BODY + HAND, BODY + 2 * HAND)
HANDS = slice(BODY, BODY + 2 * HAND)
# Landmarks of the face by name, and their numbers among the 468 of MediaPipe's face mesh.
_LIPS = (291, 270, 269, 0, 39, 40, 61, 91, 181, 17, 405, 321)
# upper edges, the left brow first
_BROWS = (336, 296, 334, 293, 300, 107, 66, 105, 63, 70)
# inner, upper, outer and lower lid, the left eye first
_LIDS = (362, 386, 263, 374, 133, 159, 33, 145)
FACE_MESH = dict(zip(FACE_NAMES, _LIPS + _BROWS + _LIDS, strict=True))
FACE = slice(HANDS.stop, HANDS.stop + len(FACE_MESH))
ALL = FACE.stop

# The body's wrists, left and right.
WRIST_JOINTS = [15, 16]
# knuckles: their bones from the wrist keep their length
PALM_JOINTS = (5, 9, 13, 17)

# Pairs of a left and a right joint.
HEAD_PAIRS = ((1, 4), (2, 5), (3, 6), (7, 8), (9, 10))
ARM_PAIRS = tuple((j, j + 1) for j in range(11, 23, 2))
LEG_PAIRS = tuple((j, j + 1) for j in range(23, 33, 2))
HAND_PAIRS = tuple((BODY + j, BODY + HAND + j) for j in range(HAND))


# (left, right) joints swapped together
FLIP_GROUPS = (HEAD_PAIRS, ARM_PAIRS, LEG_PAIRS)


# Other detectors' joint numbers by MediaPipe's, for the joints that both have.
# nose, eyes, ears, arms, legs
_SHARED = (0, 2, 5, 7, 8, *range(11, 17), *range(23, 29))
# heels, then toes; the left one first
_FEET = (29, 30, 31, 32)
# nose, eyes, ears, arms and legs, in COCO's order
_COCO = {landmark: joint for joint, landmark in enumerate(_SHARED)}
# OpenPose's, with feet.
_BODY_25 = dict(
    zip(
        _SHARED + _FEET,
        (
            0,
            16,
            15,
            18,
            17,
            5,
            2,
            6,
            3,
            7,
            4,
            12,
            9,
            13,
            10,
            14,
            11,
            21,
            24,
            19,
            22,
        ),
        strict=True,
    )
)
# OpenPose's experimental one
BODY_25B = _COCO | dict(zip(_FEET, (21, 24, 19, 22), strict=True))
_HALPE_26 = _COCO | dict(zip(_FEET, (24, 25, 20, 21), strict=True))
# Body, feet, a face mesh that is left out, and hands.
_WHOLE_BODY = {
    **_COCO,
    **dict(zip(_FEET, (19, 22, 17, 20), strict=True)),
    **{BODY + j: 91 + j for j in range(2 * HAND)},
}
# OpenPose's first model, without feet.
_COCO_18 = dict(
    zip(
        _SHARED,
        (0, 15, 14, 17, 16, 5, 2, 6, 3, 7, 4, 11, 8, 12, 9, 13, 10),
        strict=True,
    )
)
# by number of joints: name of the set, and its joint numbers by MediaPipe's
SETS: dict[int, tuple[str, dict[int, int]]] = {
    17: ("COCO", _COCO),
    18: ("OpenPose's COCO", _COCO_18),
    25: ("BODY_25", _BODY_25),
    26: ("HALPE_26", _HALPE_26),
    33: ("MediaPipe", {j: j for j in range(BODY)}),
    133: ("COCO-WholeBody", _WHOLE_BODY),
}
# The body's hand joints from the hands: little finger, index, thumb.
FROM_HANDS = {
    17: BODY + 17,
    19: BODY + 5,
    21: BODY + 2,
    18: BODY + HAND + 17,
    20: BODY + HAND + 5,
    22: BODY + HAND + 2,
}


# The body's joints that hands and face show better: wrists and knuckles, eyes and corners of the
# mouth.
_FACE_JOINTS = {
    1: "left_lid_inner",
    2: "left_lid_upper",
    3: "left_lid_outer",
    4: "right_lid_inner",
    5: "right_lid_upper",
    6: "right_lid_outer",
    9: "mouth_outer_0",
    10: "mouth_outer_6",
}
FROM_PARTS = FROM_HANDS | {15: LEFT.start, 16: RIGHT.start}
for _joint, _name in _FACE_JOINTS.items():
    FROM_PARTS[_joint] = FACE.start + FACE_NAMES.index(_name)


def joint_names() -> tuple[str, ...]:
    """Names of all joints."""
    return (*MEDIAPIPE33.names, *hand_names(), *FACE_MESH)


def zeros_as_missing(points: Float) -> Float:
    """``points [..., D]`` with NaN for points whose coordinates are all exactly 0: many detectors
    write missing joints so."""
    return np.where((points == 0).all(-1, keepdims=True), np.nan, points)


def is_known(points: Float) -> Bool:
    """``[...]`` whether all coordinates of ``points [..., D]`` are finite."""
    return np.asarray(np.isfinite(points).all(-1), np.bool_)
