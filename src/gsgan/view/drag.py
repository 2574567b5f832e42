"""Inverse kinematics: dragged joints, with bones of constant length."""

from dataclasses import dataclass

import numpy as np

from gsgan.motion.rotations import between, unit
from gsgan.skeleton import HOLISTIC
from gsgan.skeleton.joints import LEFT, RIGHT
from gsgan.skeleton.proportions import (
    FEET,
    HAND_LANDMARKS,
    HEAD_LANDMARKS,
    HIPS,
    SHOULDERS,
    middle,
)
from gsgan.utils.arrays import Float

FABRIK_ROUNDS = 20
BEND = 0.01  # of a chain's length: FABRIK cannot bend a straight chain along itself


@dataclass(frozen=True)
class Handle:
    """The joints that move with a dragged joint."""

    chain: tuple[int, ...]  # joints from the fixed one to the dragged one
    turned: tuple[int, ...] = ()  # joints that rotate with the last bone
    moved: tuple[int, ...] = ()  # joints that follow without rotating


HANDLES: dict[str, Handle] = {}
for side, shoulder, elbow, wrist, hip, knee, ankle, landmarks in (
    ("left", 11, 13, 15, 23, 25, 27, LEFT),
    ("right", 12, 14, 16, 24, 26, 28, RIGHT),
):
    # Landmarks of the hand are in the skeleton of the body, and in that with hands.
    hand = (*HAND_LANDMARKS[wrist], *range(landmarks.start, landmarks.stop))
    foot = FEET[ankle]
    HANDLES |= {
        f"{side} wrist": Handle((shoulder, elbow, wrist), turned=hand),
        f"{side} elbow": Handle((shoulder, elbow), moved=(wrist, *hand)),
        f"{side} ankle": Handle((hip, knee, ankle), turned=foot),
        f"{side} knee": Handle((hip, knee), moved=(ankle, *foot)),
    }
NOSE_NUMBER = 0
HEAD_HANDLE = "head"
BODY_HANDLE = "body"
HANDLE_NAMES = (*HANDLES, HEAD_HANDLE, BODY_HANDLE)


def _present(p: Float, joints: tuple[int, ...]) -> list[int]:
    """The joints that a pose ``[J, 3]`` has."""
    return [j for j in joints if j < len(p)]


def position(p: Float, name: str) -> Float:
    """The position ``[3]`` of a handle in a pose ``[J, 3]``, metres."""
    if name == BODY_HANDLE:
        return middle(p, HIPS)
    joint = NOSE_NUMBER if name == HEAD_HANDLE else HANDLES[name].chain[-1]
    return p[joint]


def drag(p: Float, name: str, target: Float) -> Float:
    """The pose with a handle at ``target``, or as near as the bones reach.

    Limbs bend by FABRIK from shoulder or hip; hands and feet rotate with the last bone. The head
    rotates about the neck with its face. The body moves as a whole.

    Args:
        p: ``[J, 3]`` metres, finite; 33 joints, 75 with hands or 105 with a face.
        name: of ``HANDLE_NAMES``.
        target: ``[3]`` metres.

    Source: Aristidou and Lasenby, FABRIK (2011), for the chains.
    """
    q = p.copy()
    if name == BODY_HANDLE:
        return q + (target - middle(p, HIPS))

    # The head rotates so that the nose points to the target.
    if name == HEAD_HANDLE:
        neck = middle(p, SHOULDERS)
        turn = between(p[NOSE_NUMBER] - neck, target - neck)
        face = _present(p, (*HEAD_LANDMARKS, *HOLISTIC.expression))
        q[face] = neck + (p[face] - neck) @ turn.T
        return q

    # The chain bends, then the joints behind it follow its end.
    handle = HANDLES[name]

    # The chain bends so that its end reaches the target, with its bones'
    # lengths.
    chain = list(handle.chain)
    q[chain] = fabrik(p[chain], target)

    # What hangs at the end turns with the last bone, or moves along.
    before, end = chain[-2:]
    turn = between(p[end] - p[before], q[end] - q[before])
    turned = _present(p, handle.turned)
    moved = _present(p, handle.moved)
    q[turned] = q[end] + (p[turned] - p[end]) @ turn.T
    q[moved] += q[end] - p[end]
    return q


def fabrik(chain: Float, target: Float) -> Float:
    """Joints ``[n, 3]`` with the first fixed and the last at ``target``, or as near as possible."""
    lengths = np.linalg.norm(np.diff(chain, axis=0), axis=1)
    q = chain.copy()
    root = chain[0]
    reach = lengths.sum()
    along = target - root

    # Out of reach, the chain is straight towards the target.
    if np.linalg.norm(along) >= reach:
        steps = np.concatenate([[0.0], np.cumsum(lengths)])
        return root + steps[:, None] * unit(along)

    # A chain that is straight along the target is bent to any side first.
    sine = np.linalg.norm(np.cross(unit(q[1] - root), unit(along)))
    if len(q) > 2 and sine < BEND:
        q[1:-1] += BEND * reach * unit(np.cross(along, [1.0, 2.0, 3.0]))

    # In turn, the end is put on the target and the start on the root; the others follow.
    for _ in range(FABRIK_ROUNDS):
        q[-1] = target
        for i in range(len(q) - 2, -1, -1):
            q[i] = q[i + 1] + lengths[i] * unit(q[i] - q[i + 1])
        q[0] = root
        for i in range(len(lengths)):
            q[i + 1] = q[i] + lengths[i] * unit(q[i + 1] - q[i])
    return q
