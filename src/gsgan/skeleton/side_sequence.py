"""Left and right of a sequence of skeletons, by all evidence at once.

Head, arms and legs may be exchanged, each by itself, for some frames. Evidence are the names of the
landmarks, the body itself (face, knees and toes point ahead, and shoulders turn little against
hips), and the motion between frames.
"""

from itertools import product

import numpy as np

from gsgan.skeleton.joints import FLIP_GROUPS
from gsgan.utils.arrays import Bool, Float, nanmedian

# Choices for head, arms and legs (`FLIP_GROUPS`): one by one, or the whole body.
EACH_GROUP = np.array(list(product((False, True), repeat=len(FLIP_GROUPS))))
WHOLE_BODY = np.array([[False] * len(FLIP_GROUPS), [True] * len(FLIP_GROUPS)])
# Costs are negative logarithms of probabilities.
# cost of contradicting a camera that sees a group with full confidence
LABEL_COST = 1.5
# cost of a direction that is opposite to that of a usual body, less that of an equal one, halved
BODY_COST = 2.0
# cost of a joint that moves as far as the speed below allows
MOTION_COST = 0.5
JOINT_SPEED = 1.5  # metres per second
JOINT_NOISE = 0.05  # metres
MAX_LINK = 0.5  # seconds: longer gaps say nothing
# metres between a usual person's shoulders, which set the scale
SHOULDER_WIDTH = 0.36


def sides_of_sequence(
    p: Float, labels: Float, time: Float, choices: Bool
) -> Bool:
    """The groups ``[F, G]`` whose sides are exchanged: the cheapest sequence (Viterbi).

    Args:
        p: ``[F, J, 3]`` joints of any scale, J at least 33; NaN = missing.
        labels: ``[F, G]`` what exchanging a group costs, by the labels of its detections.
        time: ``[F]`` seconds.
        choices: ``[S, G]`` that a frame has, `EACH_GROUP` or `WHOLE_BODY`.
    """
    # The person's scale, by the distance of the shoulders.
    width = np.linalg.norm(p[:, 11] - p[:, 12], axis=-1)
    scale = SHOULDER_WIDTH / nanmedian(width, 0)
    p = p[:, :33] * np.nan_to_num(scale, nan=1.0)

    # The cost of each choice in each frame, and of each pair of choices in frames that follow.
    alone = labels @ choices.T + _body_cost(p, choices)
    links = _motion_cost(p, time, choices)

    # The cheapest way to each choice, frame by frame, then the cheapest way back.
    F, S = alone.shape
    best = alone[0]
    before = np.zeros((F, S), np.int64)
    for f in range(1, F):
        ways = best[:, None] + links[f - 1]
        before[f] = ways.argmin(0)
        best = ways.min(0) + alone[f]
    chosen = np.zeros(F, np.int64)
    chosen[-1] = best.argmin()
    for f in range(F - 1, 0, -1):
        chosen[f - 1] = before[f, chosen[f]]
    return np.asarray(choices[chosen])


def _body_cost(p: Float, choices: Bool) -> Float:
    """The cost ``[F, S]`` of bodies whose parts point against each other."""
    # Directions to the left of head, chest and pelvis; exchanged sides turn them round.
    head = p[:, 7] - p[:, 8]
    chest = p[:, 11] - p[:, 12]
    pelvis = p[:, 23] - p[:, 24]
    upward = p[:, [11, 12]].mean(1) - p[:, [23, 24]].mean(1)
    eyes = p[:, [2, 5]].mean(1) - p[:, [9, 10]].mean(1)

    # Directions ahead, which do not depend on sides: of face, toes and bent knees.
    face = p[:, 0] - p[:, [7, 8]].mean(1)
    toes = (p[:, [31, 32]] - p[:, [29, 30]]).mean(1)
    knees = (p[:, [25, 26]] - (p[:, [23, 24]] + p[:, [27, 28]]) / 2).mean(1)

    # How much each part agrees with each direction, from -1 to 1.
    of_head = _cosine(np.cross(head, eyes), face)
    of_arms = _cosine(np.cross(chest, upward), face) / 2
    ahead = np.cross(pelvis, upward)
    of_legs = _cosine(ahead, toes) + _cosine(ahead, knees) / 2
    twist = _cosine(chest, pelvis)
    turn = _cosine(head, chest) / 2

    # A choice changes the signs.
    head_sign, arm_sign, leg_sign = np.where(choices, -1.0, 1.0).T
    agreement = (
        np.outer(of_head, head_sign)
        + np.outer(of_arms, arm_sign)
        + np.outer(of_legs, leg_sign)
        + np.outer(twist, arm_sign * leg_sign)
        + np.outer(turn, head_sign * arm_sign)
    )
    return -BODY_COST * agreement


def _cosine(a: Float, b: Float) -> Float:
    """The cosine ``[F]`` of the angle between vectors ``[F, 3]``; 0 where one is missing."""
    lengths = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.nan_to_num((a * b).sum(-1) / np.maximum(lengths, 1e-9))


def _motion_cost(p: Float, time: Float, choices: Bool) -> Float:
    """The cost ``[F - 1, S, S]`` of the motion from each frame to the next."""
    # Frames that are far apart in time do not follow from each other.
    step = np.diff(time)
    reach = JOINT_NOISE + JOINT_SPEED * step
    near = (step < MAX_LINK)[:, None]
    same = choices[:, None] == choices[None]  # [S, S, G]

    # A group either keeps its sides from frame to frame, or exchanges them.
    cost = np.zeros((len(step), len(choices), len(choices)))
    for g, pairs in enumerate(FLIP_GROUPS):
        left, right = np.array(pairs).T
        joints = np.r_[left, right]
        opposite = np.r_[right, left]
        kept = p[1:, joints] - p[:-1, joints]
        crossed = p[1:, opposite] - p[:-1, joints]
        costs = []
        for way in (crossed, kept):
            distance = np.linalg.norm(way, axis=-1) / reach[:, None]
            costs.append(np.log1p(distance**2))

        # A joint that is missing in one of both ways counts in neither.
        usable = np.isfinite(costs[0] + costs[1]) & near
        exchanged, straight = (
            MOTION_COST * np.where(usable, one, 0.0).sum(1) for one in costs
        )
        by_group = np.where(
            same[..., g], straight[:, None, None], exchanged[:, None, None]
        )
        cost += by_group
    return cost
