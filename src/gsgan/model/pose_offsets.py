"""Offsets of a body's points that depend on how the bones about them turn."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from gsgan.body import axis_angle_to_matrix


class PoseOffsets(nn.Module):
    """Linear in the rotations of the bones that a point follows, and constant in the rest pose.

    Skin and cloth bulge and fold where joints bend. Each control has a linear map from its own
    bones' rotations less the identity, so that no joint moves points far from it, and a pose far
    from the training poses is a sum of bends that were seen. Points get the average of the controls
    near them.

    Args:
        bones: ``[C, n]`` int64, the bones that each control follows.
        weight: ``[C, n]`` how much it follows them: a bone moves what it carries, since offsets of
            bones that only happened to turn at the same time are wrong in other poses.
        step: metres that a parameter of 1 is worth: with Adam, how fast offsets learn.

    Source: ours; sparse, local pose correctives as in STAR (Osman et al., 2020), learnt from
    images.
    """

    bones: Tensor
    weight: Tensor
    rest: Tensor

    def __init__(self, bones: Tensor, weight: Tensor, step: float) -> None:
        super().__init__()
        self.register_buffer("bones", bones, persistent=False)
        self.register_buffer("weight", weight, persistent=False)
        self.step = step
        count, followed = bones.shape
        self.field = nn.Parameter(torch.zeros(count, 9 * followed, 3))
        # Constant offsets are not trained: the residuals of Ψ can learn the same.
        self.register_buffer("rest", torch.zeros(count, 3))

    @torch.no_grad()
    def start(self, rest: Tensor, field: Tensor) -> None:
        """Sets the controls' offsets: ``[C, 3]`` metres in the rest pose, ``[C, 9 n, 3]`` per
        bend."""
        self.rest.copy_(rest)
        self.field.copy_(field / self.step)

    def bends(self, theta: Tensor) -> Tensor:
        """``[B, C, 9 n]``: what bends at each control in poses ``theta [B, J, 3]``, axis-angle."""
        # The root turns the whole body and bends nothing.
        turned = axis_angle_to_matrix(theta[:, 1:]) - torch.eye(3).to(theta)
        bent = functional.pad(turned.flatten(2), (0, 0, 1, 0))
        given = bent[:, self.bones] * self.weight.unsqueeze(-1)
        return given.flatten(2)

    def forward(
        self,
        theta: Tensor,
        interpolate: Callable[[Tensor], Tensor],
        further: Tensor | None = None,
    ) -> Tensor:
        """``[B, N, 3]`` metres, at rest.

        Args:
            theta: ``[B, J, 3]`` axis-angle, rotations of the joints.
            interpolate: gives the points ``[N, C]`` values of the controls ``[A, C]``.
            further: ``[B, C, 3]`` metres, added to the controls' offsets.
        """
        # The controls' offsets, then those of the points.
        offsets = torch.einsum("bck,ckj->bcj", self.bends(theta), self.field)
        offsets = self.rest + self.step * offsets
        if further is not None:
            offsets = offsets + further

        # The offsets of all poses at once: the table has a row for each control.
        table = offsets.transpose(0, 1).flatten(1)
        offsets_of_points = interpolate(table)
        return offsets_of_points.unflatten(1, (-1, 3)).transpose(0, 1)
