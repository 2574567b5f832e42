"""MediaPipe's 21 landmarks of a hand: names, fingers, connections, and the frame of the palm."""

from itertools import chain, pairwise, product

import torch
from torch import Tensor
from torch.nn.functional import normalize

FINGER_NAMES = ("thumb", "index", "middle", "ring", "pinky")
FINGER_PARTS = ("mcp", "pip", "dip", "tip")
HAND_NAMES = (
    "wrist",
    "thumb_cmc",
    "thumb_mcp",
    "thumb_ip",
    "thumb_tip",
    *map("_".join, product(FINGER_NAMES[1:], FINGER_PARTS)),
)
HAND = len(HAND_NAMES)
# Landmarks of each finger from base to tip, thumb first.
FINGERS = (
    (1, 2, 3, 4),
    (5, 6, 7, 8),
    (9, 10, 11, 12),
    (13, 14, 15, 16),
    (17, 18, 19, 20),
)
# Pairs of neighbouring landmarks of the fingers.
FINGER_BONES = tuple(chain.from_iterable(map(pairwise, FINGERS)))
# Landmarks of the palm.
WRIST = 0
INDEX = 5
PINKY = 17
PALM = (WRIST, INDEX, PINKY)  # points that span it
MIN_PALM = 1e-3  # metres: a smaller palm has no frame
# The connections that MediaPipe draws.
HAND_EDGES = (
    *((0, 1), (1, 2), (2, 3), (3, 4), (0, 5), (5, 6), (6, 7), (7, 8)),
    *(
        (5, 9),
        (9, 10),
        (10, 11),
        (11, 12),
        (9, 13),
        (13, 14),
        (14, 15),
        (15, 16),
    ),
    *((13, 17), (17, 18), (18, 19), (19, 20), (0, 17)),
)


def hand_names() -> tuple[str, ...]:
    """Names of 42 landmarks, the left hand's first."""
    return tuple(map("_".join, product(("left", "right"), HAND_NAMES)))


def palm_frames(palm: Tensor) -> Tensor:
    """``[..., 3, 3]`` axes of palms, from their `PALM` ``[..., 3, 3]`` in metres.

    Columns are the direction to the middle of the knuckles, the one from the little
    finger to the index, and their cross product, which points out of a left palm and into a right
    one. They shrink to zero as the palm does.
    """
    wrist, index, pinky = palm.unbind(-2)
    along = normalize((index + pinky) / 2 - wrist, dim=-1, eps=MIN_PALM)

    # The part of the line between the knuckles that is orthogonal to the first axis.
    across = index - pinky
    across = across - (across * along).sum(-1, keepdim=True) * along
    across = normalize(across, dim=-1, eps=MIN_PALM)
    return torch.stack(
        [along, across, torch.linalg.cross(along, across)], dim=-1
    )
