"""Corrections of the body's pose in training frames, learned with the avatar."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from gsgan.scene import BodyPose

FIXED = ("finger", "toe")  # joints that images are too coarse to turn
METRES = 0.3  # of the translation's learning rate per radian of the angles'
ANGLE, DISTANCE = 0.1, 0.02  # radians and metres that the prior counts as one


class PoseCorrections(nn.Module):
    """One correction of the body's pose per training frame: parameters beside the avatar's.

    What a fit to silhouettes cannot see, such as a limb's twist, shows in its colours. Held-out
    frames have no correction: theirs is zero.

    Args:
        frames: ids of the training frames.
        joint_names: of the body.

    Source: ours; SMPL parameters are refined so in HumanNeRF and its successors.
    """

    frames: Tensor
    free: Tensor

    def __init__(self, frames: Sequence[int], joint_names: Sequence[str]) -> None:
        super().__init__()
        self.register_buffer("frames", torch.tensor(sorted(frames)), persistent=False)
        free = torch.tensor([[float(not name.startswith(FIXED))] for name in joint_names])
        self.register_buffer("free", free, persistent=False)
        self.theta = nn.Parameter(torch.zeros(len(frames), len(joint_names), 3))
        self.transl = nn.Parameter(torch.zeros(len(frames), 3))

    def parameter_groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """(parameters, multiplier of the learning rate)."""
        return [([self.theta], 1.0), ([self.transl], METRES)]

    def forward(self, body: BodyPose, frame_id: Tensor) -> tuple[BodyPose, Tensor]:
        """The corrected poses of training frames ``[B]``, and their mean square as a prior."""
        row = torch.searchsorted(self.frames, frame_id)
        turn, move = self.theta[row] * self.free, self.transl[row]
        prior = (turn / ANGLE).square().mean() + (move / DISTANCE).square().mean()
        return BodyPose(body.theta + turn, body.transl + move), prior
