"""Detects skeletons whose left and right are swapped."""

from itertools import compress

import torch
from torch import Tensor
from torch.nn.functional import normalize

APART = -0.3  # maximum cosine of a swapped pair's line against the other pairs'
# maximum cosine of swapped lines against the left by feet and head
OPPOSED = -0.6
SIDE_PAIRS = {
    "hips": (23, 24),
    "shoulders": (11, 12),
    "ears": (7, 8),
    "eyes": (2, 5),
}
NOSE_JOINT = 0
LEG_JOINTS = ((25, 27, 29, 31), (26, 28, 30, 32))  # knee, ankle, heel, toes


def refuse_swapped(p: Tensor, valid: Tensor) -> None:
    """Refuses a capture or motion whose left and right are swapped in most frames.

    A single frame never is: an extreme pose looks the same.

    Lines from right to left of hips, shoulders, ears and eyes must agree; and with the left as it
    follows from each foot and its shank, and from nose and eyes, whatever they are called.

    Args:
        p: ``[B, 33, 3]`` finite.
        valid: ``[B, 33]`` bool, landmarks that were seen.

    Raises:
        ValueError: naming the pairs that are swapped.
    """

    if len(p) < 2:
        return

    def mask_joints(v: Tensor, joints: tuple[int, ...]) -> Tensor:
        return v * valid[:, joints].all(1, keepdim=True)

    # The left, as it follows from each foot: shank and foot span the sagittal plane.
    by_feet = torch.zeros_like(p[:, 0])
    for knee, ankle, heel, toes in LEG_JOINTS:
        shank = p[:, knee] - p[:, ankle]
        left = torch.linalg.cross(shank, p[:, toes] - p[:, heel])
        by_feet = by_feet + mask_joints(left, (knee, ankle, heel, toes))

    # The left, as it follows from the head: the eyes are above the nose, the ears behind it.
    ears = p[:, SIDE_PAIRS["ears"]].mean(1)
    eyes = p[:, SIDE_PAIRS["eyes"]].mean(1)
    by_head = torch.linalg.cross(
        eyes - p[:, NOSE_JOINT], p[:, NOSE_JOINT] - ears
    )
    by_head = mask_joints(
        by_head, (NOSE_JOINT, *SIDE_PAIRS["ears"], *SIDE_PAIRS["eyes"])
    )

    # The lines from right to left that the names of the landmarks state.
    named = [
        mask_joints(p[:, a] - p[:, b], (a, b)) for a, b in SIDE_PAIRS.values()
    ]
    lines = normalize(torch.stack(named, dim=1), dim=-1)

    # A line that opposes the sum of the others stands apart.
    others = normalize(lines.sum(1, keepdim=True) - lines, dim=-1)
    apart = (lines * others).sum(-1) < APART

    # The remaining lines together may oppose feet and head.
    remaining = lines * ~apart.unsqueeze(-1)
    whole = normalize(remaining.sum(1), dim=-1)
    left = normalize(by_feet, dim=-1) + normalize(by_head, dim=-1)
    opposed = (whole * left).sum(-1, keepdim=True) < OPPOSED

    # A pair is swapped if it is so in most of the frames that show it.
    shown = (lines != 0).any(-1)
    contrary = (apart ^ opposed) & shown
    wrong = contrary.sum(0) > 0.5 * shown.sum(0)
    swapped = list(compress(SIDE_PAIRS, wrong.tolist()))
    if swapped:
        raise ValueError(
            f"left and right are swapped: by the direction of nose and toes, the left of "
            f"{', '.join(swapped)} lies on the person's right; exchange the names, or mirror the "
            "joints back"
        )
