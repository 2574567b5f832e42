"""Skeletons with hands and face: MediaPipe's 33 pose landmarks, 21 of each hand, 30 of the face.

Units and axes are as in `gsgan.skeleton.template`. Constants only.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from gsgan.skeleton.face import (
    FACE,
    FACE_NAMES,
    face_groups,
    face_links,
    face_mirror,
    rest_face,
)
from gsgan.skeleton.hands import (
    FINGER_NAMES,
    FINGERS,
    HAND,
    HAND_EDGES,
    PALM,
    WRIST,
    hand_names,
)
from gsgan.skeleton.template import (
    MEDIAPIPE33,
    N_HUBS,
    Edge,
    SkeletonTemplate,
    Vector,
)
from gsgan.utils.checks import one_of

POSE = MEDIAPIPE33
STARTS = (len(POSE.names), len(POSE.names) + HAND)  # each hand's wrist
# shoulder, elbow and wrist of the pose
POSE_ARMS = (11, 13, 15), (12, 14, 16)
HUBS_WITH_PALMS = N_HUBS + len(STARTS)
# Lengths of a straight finger's bones and of the thumb's last ones, metres.
FINGER_LENGTHS = {
    "index": (0.040, 0.024, 0.020),
    "middle": (0.044, 0.027, 0.021),
    "ring": (0.040, 0.026, 0.020),
    "pinky": (0.032, 0.019, 0.018),
}
THUMB_LENGTHS = (0.034, 0.026)
# Directions of straight fingers and of a spread thumb, in the palm's axes.
STRAIGHT: Vector = (1.0, 0.0, 0.0)
SPREAD: Vector = (0.5**0.5, 0.5**0.5, 0.0)


def _chains(start: int) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(start + j for j in finger) for finger in FINGERS)


def _limbs(side: int) -> list[Edge]:
    """The forearm to the hand's own wrist, the palm's bones, and the fingers' from base to tip."""
    # The limbs to the bases of all fingers come before those along the fingers.
    wrist = STARTS[side]
    chains = _chains(wrist)
    limbs = [(POSE_ARMS[side][1], wrist)]
    for chain in chains:
        limbs.append((wrist, chain[0]))
    for chain in chains:
        limbs += pairwise(chain)
    return limbs


def _hand_at_rest() -> np.ndarray:
    """``[21, 3]`` a flat left hand that continues the pose's wrist and knuckles."""
    rest = dict(zip(POSE.names, np.asarray(POSE.rest_positions), strict=True))
    wrist = rest["left_wrist"]
    index = rest["left_index"]
    pinky = rest["left_pinky"]
    thumb = rest["left_thumb"]

    # Fingers point from the wrist to the middle of the knuckles.
    along = (index + pinky) / 2 - wrist
    along = along / np.linalg.norm(along)
    p = np.zeros((HAND, 3))
    p[WRIST] = wrist

    # Straight fingers, whose knuckles are on a slight arc.
    for k, (finger, lengths) in enumerate(FINGER_LENGTHS.items()):
        knuckle, *joints = FINGERS[1 + k]
        share = k / 3
        bulge = 0.008 * (finger in ("middle", "ring"))
        p[knuckle] = (1 - share) * index + share * pinky + bulge * along
        for joint, at in zip(joints, np.cumsum(lengths), strict=True):
            p[joint] = p[knuckle] + at * along

    # The thumb points away from its base.
    base, knuckle, *joints = FINGERS[0]
    p[base] = wrist + 0.45 * (thumb - wrist)
    p[knuckle] = thumb
    outwards = (thumb - p[base]) / np.linalg.norm(thumb - p[base])
    for joint, at in zip(joints, np.cumsum(THUMB_LENGTHS), strict=True):
        p[joint] = thumb + at * outwards
    return p


def _with_hands() -> SkeletonTemplate:
    """MediaPipe's pose with two hands of 21 landmarks."""
    # Palms are additional hubs, so that the frames of limbs have larger numbers.
    limbs = list(POSE.limbs)
    directions = list(POSE.rest_directions)
    parents = [p if p < N_HUBS else p + len(STARTS) for p in POSE.limb_parents]

    # Each hand adds its limbs: the palm follows the forearm, fingers follow the palm.
    groups = []
    bare = []
    for side, start in enumerate(STARTS):
        first = len(limbs)
        bare.append(first)
        forearm = POSE.limbs.index(POSE_ARMS[side][1:])
        limbs += _limbs(side)
        parents += [parents[forearm], *[HUBS_WITH_PALMS + first] * len(FINGERS)]
        directions += [POSE.rest_directions[forearm]] * (1 + len(FINGERS))

        # The first bone of a finger follows the palm, each further one the bone
        # before.
        for k, chain in enumerate(_chains(start)):
            place = HUBS_WITH_PALMS + len(parents)
            parents += [N_HUBS + side, place, place + 1]
            directions += [STRAIGHT if k else SPREAD] * 3
            name = f"{('left', 'right')[side]}_{FINGER_NAMES[k]}"
            groups.append((name, tuple(pairwise((start, *chain)))))

    # The right hand at rest is the mirror image of the left one.
    left = _hand_at_rest()
    rest = np.concatenate(
        [np.asarray(POSE.rest_positions), left, left * [-1, 1, 1]]
    )

    # Edges to draw and for the graph network, within hands and from wrist to hand.
    edges = tuple(
        (start + a, start + b) for start in STARTS for a, b in HAND_EDGES
    )
    wrists = tuple(
        (arm[-1], start) for arm, start in zip(POSE_ARMS, STARTS, strict=True)
    )

    # The hands' own forearms have no cylinder; left and right hands exchange in the mirror.
    fingers = set(range(len(POSE.limbs), len(limbs))) - set(bare)
    left_start, right_start = STARTS
    swapped = [
        *range(right_start, right_start + HAND),
        *range(left_start, right_start),
    ]
    names = [name.replace("wrist", "hand_wrist") for name in hand_names()]
    wrist, index, pinky = PALM
    return replace(
        POSE,
        names=(*POSE.names, *names),
        edges=(*POSE.edges, *edges),
        limbs=tuple(limbs),
        limb_parents=tuple(parents),
        rest_directions=tuple(directions),
        rest_positions=tuple((x, y, z) for x, y, z in rest.tolist()),
        mirror=(*POSE.mirror, *swapped),
        draw_groups=(*POSE.draw_groups, *groups),
        gnn_edges=(*POSE.gnn_edges, *edges, *wrists),
        palms=tuple(
            (start + wrist, start + index, start + pinky) for start in STARTS
        ),
        fingers=tuple(sorted(fingers)),
        bare=tuple(bare),
    )


def _with_face(hands: SkeletonTemplate) -> SkeletonTemplate:
    """A template with the 30 landmarks of a face, which have no limbs."""
    # The face's landmarks follow those of the hands.
    start = len(hands.names)
    groups = face_groups(start)
    edges: list[Edge] = []
    for _, group in groups:
        edges += group
    return replace(
        hands,
        names=(*hands.names, *FACE_NAMES),
        edges=(*hands.edges, *edges),
        rest_positions=(*hands.rest_positions, *rest_face()),
        mirror=(*hands.mirror, *face_mirror(start)),
        draw_groups=(*hands.draw_groups, *groups),
        gnn_edges=(*hands.gnn_edges, *edges, *face_links(start)),
        expression=tuple(range(start, start + FACE)),
    )


MEDIAPIPE33_HANDS = _with_hands()
"""75 joints, 77 edges, 64 limbs: 40 bones of hands, and two forearms to the hands' own wrists."""

HOLISTIC = _with_face(MEDIAPIPE33_HANDS)
"""105 joints, 105 edges: also lips, brows and lids, which have no limbs."""

TEMPLATES = {
    "mediapipe33": MEDIAPIPE33,
    "mediapipe33_hands": MEDIAPIPE33_HANDS,
    "holistic": HOLISTIC,
}
"""Templates by the values of ``data.skeleton``; each begins with the joints of the one before."""


def template_of(
    skeleton: str, face: Sequence[Vector] | None
) -> SkeletonTemplate:
    """A template by its name, with a person's own face at rest if it is known."""
    template = TEMPLATES[skeleton]
    return template if face is None else template.with_face(face)


def named_template(template: SkeletonTemplate | str) -> SkeletonTemplate:
    """The template of a name.

    Raises:
        ConfigError: when there is none of that name.
    """
    if isinstance(template, SkeletonTemplate):
        return template
    return TEMPLATES[one_of("data.skeleton", template, TEMPLATES)]
