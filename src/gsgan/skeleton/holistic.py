"""Skeletons with hands and face: MediaPipe's 33 pose landmarks, 21 of each hand, 30 of the face.

Convention: as in `gsgan.skeleton.template`. Constants only.
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
    PINKY,
    WRIST,
    hand_names,
)
from gsgan.skeleton.template import MEDIAPIPE33, N_HUBS, Edge, SkeletonTemplate, Vector
from gsgan.utils.checks import one_of

POSE = MEDIAPIPE33
STARTS = (len(POSE.names), len(POSE.names) + HAND)  # each hand's wrist
ARMS = ((11, 13, 15), (12, 14, 16))  # shoulder, elbow and wrist of the pose
HUBS = N_HUBS + len(STARTS)
# Metres, lengths of a straight finger's bones; the thumb's from its base.
BONES = {
    "index": (0.040, 0.024, 0.020),
    "middle": (0.044, 0.027, 0.021),
    "ring": (0.040, 0.026, 0.020),
    "pinky": (0.032, 0.019, 0.018),
}
THUMB = (0.034, 0.026)
STRAIGHT: Vector = (1.0, 0.0, 0.0)  # in the palm's axes
SPREAD: Vector = (0.5**0.5, 0.5**0.5, 0.0)  # a thumb


def _chains(start: int) -> tuple[tuple[int, ...], ...]:
    return tuple(tuple(start + j for j in finger) for finger in FINGERS)


def _limbs(side: int) -> tuple[Edge, ...]:
    """The forearm to the hand's own wrist, the palm's bones, and the fingers' from base to tip."""
    wrist = STARTS[side]
    chains = _chains(STARTS[side])
    palm = tuple((wrist, base) for base, *_ in chains)
    return (
        (ARMS[side][1], wrist),
        *palm,
        *(pair for chain in chains for pair in pairwise(chain)),
    )


def _hand_at_rest() -> np.ndarray:
    """``[21, 3]`` a flat left hand that continues the pose's wrist and knuckles."""
    rest = dict(zip(POSE.names, np.asarray(POSE.rest_positions), strict=True))
    wrist, index, pinky, thumb = (
        rest[f"left_{n}"] for n in ("wrist", "index", "pinky", "thumb")
    )
    along = (index + pinky) / 2 - wrist
    along = along / np.linalg.norm(along)
    p = np.zeros((HAND, 3))
    p[WRIST] = wrist
    for k, (finger, bones) in enumerate(BONES.items()):
        chain = FINGERS[1 + k]
        share = k / 3
        bulge = 0.008 * (finger in ("middle", "ring"))
        p[chain[0]] = (1 - share) * index + share * pinky + bulge * along
        for joint, at in zip(chain[1:], np.cumsum(bones), strict=True):
            p[joint] = p[chain[0]] + at * along
    base, knuckle, *tips = FINGERS[0]
    p[base] = wrist + 0.45 * (thumb - wrist)
    p[knuckle] = thumb
    outwards = (thumb - p[base]) / np.linalg.norm(thumb - p[base])
    for joint, at in zip(tips, np.cumsum(THUMB), strict=True):
        p[joint] = thumb + at * outwards
    assert np.allclose(p[PINKY], pinky)
    return p


def _with_hands() -> SkeletonTemplate:
    limbs = list(POSE.limbs)
    parents = []
    directions = list(POSE.rest_directions)
    parents = [p if p < N_HUBS else p + len(STARTS) for p in POSE.limb_parents]

    # Each hand adds its limbs: the palm follows the forearm, fingers follow the palm.
    groups = []
    for side, start in enumerate(STARTS):
        first = len(limbs)
        forearm = POSE.limbs.index(ARMS[side][1:])
        limbs += _limbs(side)
        parents += [parents[forearm], *[HUBS + first] * len(FINGERS)]
        directions += [POSE.rest_directions[forearm]] * (1 + len(FINGERS))
        for k, chain in enumerate(_chains(start)):
            place = HUBS + len(parents)
            parents += [N_HUBS + side, place, place + 1]
            directions += [STRAIGHT if k else SPREAD] * 3
            name = f"{('left', 'right')[side]}_{FINGER_NAMES[k]}"
            segments = zip((start, *chain), chain, strict=False)
            groups.append((name, tuple(segments)))

    # The right hand at rest is the mirror image of the left one.
    left = _hand_at_rest()
    rest = np.concatenate([np.asarray(POSE.rest_positions), left, left * [-1, 1, 1]])

    # Edges to draw and for the graph network, within hands and from wrist to hand.
    edges = tuple((start + a, start + b) for start in STARTS for a, b in HAND_EDGES)
    wrists = tuple((arm[-1], start) for arm, start in zip(ARMS, STARTS, strict=True))

    # The palms' own limbs have no cylinder; left and right hands exchange in the mirror.
    own = len(_limbs(0))
    bare = tuple(len(POSE.limbs) + side * own for side in (0, 1))
    swapped = tuple(start + j for start in reversed(STARTS) for j in range(HAND))
    return replace(
        POSE,
        names=(
            *POSE.names,
            *(name.replace("wrist", "hand_wrist") for name in hand_names()),
        ),
        edges=(*POSE.edges, *edges),
        limbs=tuple(limbs),
        limb_parents=tuple(parents),
        rest_directions=tuple(directions),
        rest_positions=tuple((x, y, z) for x, y, z in rest.tolist()),
        mirror=(*POSE.mirror, *swapped),
        draw_groups=(*POSE.draw_groups, *groups),
        gnn_edges=(*POSE.gnn_edges, *edges, *wrists),
        palms=tuple(
            (start + PALM[0], start + PALM[1], start + PALM[2]) for start in STARTS
        ),
        fingers=tuple(i for i in range(len(POSE.limbs), len(limbs)) if i not in bare),
        bare=bare,
    )


def _with_face(hands: SkeletonTemplate) -> SkeletonTemplate:
    start = len(hands.names)
    groups = face_groups(start)
    edges = tuple(edge for _, group in groups for edge in group)
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
"""By the name that ``data.skeleton`` has; the joints of each are the first ones of the next."""


def template_of(skeleton: str, face: Sequence[Vector] | None) -> SkeletonTemplate:
    """A template by its name, with a person's own face at rest where there is one."""
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
