"""Left and right: which cameras swapped them in which frames.

Detectors confuse left and right, mostly when a person is seen from behind. Within a frame, the
triangulated points fit best when all cameras agree, so that each camera's swap is known up to the
opposite choice in all cameras. Which of both is right is decided for the whole sequence
(`gsgan.skeleton.side_sequence`).
"""

from collections.abc import Callable, Sequence

import numpy as np

from gsgan.prepare.camera_array import CameraArray
from gsgan.prepare.triangulate import points_and_cost
from gsgan.skeleton.joints import FLIP_GROUPS
from gsgan.skeleton.side_sequence import (
    EACH_GROUP,
    LABEL_COST,
    sides_of_sequence,
)
from gsgan.utils.arrays import Bool, Float, Ints

Pairs = tuple[tuple[int, int], ...]

# mean loss per detection that a swap must save; an error of HALF_WEIGHT_ERROR costs 0.7
FLIP_GAIN = 0.15
# minimum number of a group: hips at the border of an image do not tell left from right
MIN_GROUP = 3


def find_flips(
    cameras: CameraArray, uv: Float, weight: Float, time: Float
) -> Bool:
    """The groups of joints ``[C, F, G]``, `FLIP_GROUPS`, that each camera swapped in each frame.

    Args:
        cameras: ``C`` cameras.
        uv: ``[C, F, J, 2]`` undistorted pixels, J at least 33.
        weight: ``[C, F, J]`` their confidence.
        time: ``[F]`` seconds.
    """
    # Within a frame, groups are independent: a detector may confuse the legs only.
    C, F, _ = weight.shape
    flips = np.zeros((C, F, len(FLIP_GROUPS)), bool)
    labels = np.zeros((F, len(FLIP_GROUPS)))
    for g, pairs in enumerate(FLIP_GROUPS):
        flips[..., g], votes = _group_flips(cameras, uv, weight, pairs)

        # What the opposite choice costs more than this one, by the labels of the detections.
        agreeing = np.where(flips[..., g], -votes, votes)
        labels[:, g] = LABEL_COST * agreeing.sum(0)

    # The same choice or its opposite, for the whole sequence.
    sided = apply_flips(uv, flips, FLIP_GROUPS)
    seen = apply_flips(weight, flips, FLIP_GROUPS)
    p, _ = points_and_cost(cameras, sided, seen)
    return flips ^ sides_of_sequence(p, labels, time, EACH_GROUP)


def apply_flips(values: Float, flips: Bool, groups: Sequence[Pairs]) -> Float:
    """Values ``[C, F, J, ...]`` with left and right exchanged where ``flips [C, F, G]``."""
    result = values.copy()
    for g, pairs in enumerate(groups):
        # The flips of this group, in the dimensions of the values.
        flipped = np.expand_dims(flips[..., g], tuple(range(2, values.ndim)))
        left, right = np.array(pairs).T
        lefts = values[:, :, left]
        rights = values[:, :, right]
        result[:, :, left] = np.where(flipped, rights, lefts)
        result[:, :, right] = np.where(flipped, lefts, rights)
    return result


def _group_flips(
    cameras: CameraArray, uv: Float, weight: Float, pairs: Pairs
) -> tuple[Bool, Float]:
    """The swaps ``[C, F]`` of one group up to the opposite choice, and mean confidences."""
    # The joints of a pair become adjacent: j and j ^ 1.
    joints = np.ravel(pairs)
    adjacent = [tuple((j, j + 1) for j in range(0, len(joints), 2))]
    uv = uv[:, :, joints]
    weight = weight[:, :, joints]
    C, F, _ = weight.shape

    # The cost of any choice of flips; weights belong to their detections.
    def cost_of(flips: Bool, frames: Ints) -> Float:
        flips = flips[..., None]
        sided = apply_flips(uv[:, frames], flips, adjacent)
        seen = apply_flips(weight[:, frames], flips, adjacent)
        _, cost = points_and_cost(cameras, sided, seen)
        return cost

    # The swaps that make the points fit better.
    few = (weight > 0).sum(-1) < MIN_GROUP
    price = np.where(few, np.inf, FLIP_GAIN * weight.sum(-1))
    flips = cheapest_flips(cost_of, np.zeros((C, F), bool), price)
    return flips, np.where(few, 0.0, weight.mean(-1))


def cheapest_flips(
    cost_of: Callable[[Bool, Ints], Float],
    flips: Bool,
    price: Float,
) -> Bool:
    """Flips ``[C, F]``: one camera at a time is changed as long as that saves more than its price.

    Args:
        cost_of: cost ``[f]`` of flips ``[C, f]`` in these ``f`` frames.
        flips: ``[C, F]`` initial values.
        price: ``[C, F]`` that a change must save.
    """
    # Frames are active as long as the last change saved something.
    C, F = flips.shape
    flips = flips.copy()
    active = np.arange(F)
    toggles = np.eye(C, dtype=bool)[:, :, None]
    cost = cost_of(flips, active)
    for _ in range(C):
        # The cost of changing each camera, in the active frames.
        trials = np.stack(
            [cost_of(flips[:, active] ^ one, active) for one in toggles]
        )
        saved = cost[active] - trials - price[:, active]

        # The camera whose change saves most is changed.
        best = saved.argmax(0)
        better = saved.max(0) > 0

        # Frames in which nothing is saved are done.
        active = active[better]
        best = best[better]
        if not len(active):
            break
        flips[best, active] ^= True
        cost[active] = trials[best, better.nonzero()[0]]
    return flips
