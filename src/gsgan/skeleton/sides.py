"""Left and right of a skeleton: whether they are swapped."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

# A pair's line that lies this far from the person's left (a cosine) has its sides swapped.
OPPOSED = -0.3
PAIRS = {"hips": (23, 24), "shoulders": (11, 12), "ears": (7, 8), "eyes": (2, 5)}
NOSE, LEGS = 0, ((25, 27, 29, 31), (26, 28, 30, 32))  # knee, ankle, heel, toes


def refuse_swapped(p: Tensor, valid: Tensor) -> None:
    """Refuses skeletons whose left and right are swapped in most frames.

    Which side is the left follows from a foot and its shank, and from nose, ears and eyes, whatever
    they are called.

    Args:
        p: ``[B, 33, 3]`` finite.
        valid: ``[B, 33]`` bool, landmarks that were seen.

    Raises:
        ValueError: naming the pairs that are swapped.
    """

    def seen(v: Tensor, joints: tuple[int, ...]) -> Tensor:
        return v * valid[:, joints].all(1, keepdim=True)

    by_feet = torch.zeros_like(p[:, 0])
    for knee, ankle, heel, toes in LEGS:
        left = torch.linalg.cross(p[:, knee] - p[:, ankle], p[:, toes] - p[:, heel])
        by_feet = by_feet + seen(left, (knee, ankle, heel, toes))
    ears, eyes = (p[:, PAIRS[name]].mean(1) for name in ("ears", "eyes"))
    by_head = torch.linalg.cross(eyes - p[:, NOSE], p[:, NOSE] - ears)
    by_head = seen(by_head, (NOSE, *PAIRS["ears"], *PAIRS["eyes"]))
    swapped = []
    for name, (a, b) in PAIRS.items():
        line = seen(p[:, a] - p[:, b], (a, b))
        left = by_feet if name == "hips" else by_head  # a head never faces backwards
        cosine = (normalize(line, dim=-1) * normalize(left, dim=-1)).sum(-1)
        told = cosine[cosine != 0]
        if len(told) and (told < OPPOSED).float().mean() > 0.5:
            swapped.append(name)
    if swapped:
        raise ValueError(
            f"left and right are swapped: by the direction of nose and toes, the left of "
            f"{', '.join(swapped)} lies on the person's right; exchange the names, or mirror the "
            "joints back"
        )
