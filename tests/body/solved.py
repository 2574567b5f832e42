"""What the tests of the solve share: skeletons of poses, and skeletons that a capture may hold."""

import math

import torch
from torch import Tensor

from gsgan.body import free_body
from gsgan.scene import BodyPose


def shown(
    truth: BodyPose, noise: float = 0.0, joints: int = 75
) -> tuple[Tensor, Tensor]:
    """``[B, joints, 3]`` and their visibility."""
    body = free_body()
    p = torch.cat(
        [body.posed_landmarks(truth), body.posed_hands(truth)], dim=1
    )[:, :joints]
    p = p + noise * torch.randn(
        p.shape, generator=torch.Generator().manual_seed(0)
    )
    return p, torch.ones(p.shape[:2])


def damaged(kind: str) -> tuple[Tensor, Tensor]:
    p, seen = shown(BodyPose(torch.zeros(2, 56, 3), torch.zeros(2, 3)))
    if kind == "straight legs":
        p[:, 25:27] = (p[:, 23:25] + p[:, 27:29]) / 2
    elif kind == "one point":
        p[:] = p[:, :1]
    elif kind == "no arm":
        p[:, 13], p[:, 15] = p[:, 11], p[:, 11]
    elif kind == "folded limbs":
        p[:, 15], p[:, 27] = p[:, 11], p[:, 23]
    elif kind == "NaN":
        p[:, 13:23] = math.nan
    elif kind == "NaN visibility":
        seen[:, 13:40] = math.nan
    elif kind == "infinite":
        p[0, 0], p[1, 31], p[0, 40] = math.inf, -math.inf, math.inf
    elif kind == "far":
        p += 1e4
    elif kind == "only the trunk":
        seen[:] = 0
        seen[:, [11, 12, 23, 24]] = 1
    elif kind == "estimated hips":
        seen[:, 23:33] = 0
        p[:, 23:25] += 0.03
    elif kind == "hands of one point":
        p[:, 33:54] = p[:, 33:34]
    elif kind == "lost fingers":
        seen[:, 36:40], seen[:, 54], seen[:, 60:64] = 0, 0, 0
    elif kind == "lying on the side":
        p = p[..., [2, 0, 1]]
    elif kind == "upside down":
        p = p * torch.tensor([-1.0, 1.0, -1.0])
    return p, seen
