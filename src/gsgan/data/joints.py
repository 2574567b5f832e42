"""The 33 + 21 + 21 joints of a capture, and where other detectors keep them."""

from __future__ import annotations

from gsgan.skeleton.template import MEDIAPIPE33

BODY, HAND = 33, 21
LEFT, RIGHT = slice(BODY, BODY + HAND), slice(BODY + HAND, BODY + 2 * HAND)
ALL = BODY + 2 * HAND

HAND_NAMES = (
    "wrist",
    *(f"thumb_{part}" for part in ("cmc", "mcp", "ip", "tip")),
    *(
        f"{finger}_{part}"
        for finger in ("index", "middle", "ring", "pinky")
        for part in ("mcp", "pip", "dip", "tip")
    ),
)
PALM = (5, 9, 13, 17)  # knuckles: their bones from the wrist keep their length

HEAD_PAIRS = ((1, 4), (2, 5), (3, 6), (7, 8), (9, 10))
ARM_PAIRS = tuple((j, j + 1) for j in range(11, 23, 2))
LEG_PAIRS = tuple((j, j + 1) for j in range(23, 33, 2))
HAND_PAIRS = tuple((BODY + j, BODY + HAND + j) for j in range(HAND))


def flip_groups(hands: bool) -> tuple[tuple[tuple[int, int], ...], ...]:
    """(left, right) joints that a detector swaps together: head, arms (with hands), legs."""
    return HEAD_PAIRS, ARM_PAIRS + (HAND_PAIRS if hands else ()), LEG_PAIRS


# Other detectors' numbers by MediaPipe's; a joint that is not listed they do not know.
_COCO = {
    0: 0,
    2: 1,
    5: 2,
    7: 3,
    8: 4,
    11: 5,
    12: 6,
    13: 7,
    14: 8,
    15: 9,
    16: 10,
    23: 11,
    24: 12,
    25: 13,
    26: 14,
    27: 15,
    28: 16,
}
_BODY_25 = {
    0: 0,
    2: 16,
    5: 15,
    7: 18,
    8: 17,
    11: 5,
    12: 2,
    13: 6,
    14: 3,
    15: 7,
    16: 4,
    23: 12,
    24: 9,
    25: 13,
    26: 10,
    27: 14,
    28: 11,
    29: 21,
    30: 24,
    31: 19,
    32: 22,
}
_HALPE_26 = {**_COCO, 29: 24, 30: 25, 31: 20, 32: 21}
_WHOLE_BODY = {
    **_COCO,
    29: 19,
    30: 22,
    31: 17,
    32: 20,
    **{BODY + j: 91 + j for j in range(HAND)},
    **{BODY + HAND + j: 112 + j for j in range(HAND)},
}
SETS: dict[int, tuple[str, dict[int, int]]] = {
    17: ("COCO", _COCO),
    25: ("BODY_25", _BODY_25),
    26: ("HALPE_26", _HALPE_26),
    33: ("MediaPipe", {j: j for j in range(BODY)}),
    133: ("COCO-WholeBody", _WHOLE_BODY),
}
# Where hands are known but the body's hand joints are not: little finger, index, thumb.
FROM_HANDS = {
    17: BODY + 17,
    19: BODY + 5,
    21: BODY + 2,
    18: BODY + HAND + 17,
    20: BODY + HAND + 5,
    22: BODY + HAND + 2,
}


def joint_names() -> tuple[str, ...]:
    """Names of all 75 joints."""
    return MEDIAPIPE33.names + hand_names()


def hand_names() -> tuple[str, ...]:
    """Names of the 42 hand joints, left hand first."""
    return tuple(f"{side}_{name}" for side in ("left", "right") for name in HAND_NAMES)
