"""The ``lbs_splat`` baseline: Gaussians on the body's surface, moved by linear blend skinning."""

from __future__ import annotations

import math

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor, nn
from torch.nn import functional

from gsgan.body import SkinnedBody
from gsgan.model.bounded import bounded
from gsgan.model.skinned_points import SkinnedPoints
from gsgan.scene import BodyPose, Gaussians
from gsgan.splat.sh import sh_to_colour


class SurfaceGaussians(nn.Module):
    """Canonical Gaussians with learned offsets from the body, shapes and colours.

    Only the skinning depends on the pose: the family of GauHuman and 3DGS-Avatar, without their
    pose-dependent networks.

    Args:
        body: vertices, weights and joints.
        body_height: metres, the length scale of the bounds.
        points: vertices used, spread evenly over the surface; None for all.
        sh_degree: 0 (no view dependence) to 3.
        opacity: initial opacity.
        scale: initial standard deviation, as a share of the distance to the nearest neighbour.
        mean_bound: largest distance of a mean from its vertex, body heights.
        scale_min, scale_max: body heights, the range of every scale.
        logit_bound: opacity logits are kept within ± this.

    Source: the baselines of the paper's Sec. 4.
    """

    def __init__(
        self,
        body: SkinnedBody,
        body_height: float,
        *,
        points: int | None = None,
        sh_degree: int = 0,
        opacity: float = 0.5,
        scale: float = 0.7,
        mean_bound: float = 0.25,
        scale_min: float = 1e-4,
        scale_max: float = 0.06,
        logit_bound: float = 8.0,
    ) -> None:
        super().__init__()
        if not 0 <= sh_degree <= 3:
            raise ValueError(f"SurfaceGaussians: sh_degree must be 0, 1, 2 or 3, got {sh_degree}")
        self.points = SkinnedPoints(body, points)
        count = len(self.points)
        self.features, self.sh_degree, self.body_height = 0, sh_degree, float(body_height)
        self.active_degree = sh_degree  # raised during training; higher degrees are not computed
        self.mean_bound, self.logit_bound = mean_bound, logit_bound
        self.scale_range = (scale_min, scale_max)
        self.offsets = nn.Parameter(torch.zeros(count, 3))
        self.quats = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1))
        spacing = (scale * self.points.spacing).log()
        self.log_scales = nn.Parameter(spacing.unsqueeze(-1).repeat(1, 3))
        logit = math.log(opacity / (1 - opacity))
        self.logit_opacities = nn.Parameter(torch.full((count,), logit))
        self.sh = nn.Parameter(torch.zeros(count, (sh_degree + 1) ** 2, 3))

    def parameter_groups(self) -> list[tuple[list[nn.Parameter], float]]:
        """(parameters, multiplier of the learning rate): bare parameters need higher rates than an
        MLP's weights."""
        return [
            ([self.offsets, self.quats], 1.0),
            ([self.log_scales], 5.0),
            ([self.sh], 10.0),
            ([self.logit_opacities], 25.0),
        ]

    def forward(self, pose: BodyPose, eye: Tensor) -> Gaussians:
        """The Gaussians in pose, coloured as seen from ``eye`` ``[B, 3]`` (world, metres)."""
        A, t = self.points.blend(pose)
        batch = len(A)
        offsets = self.mean_bound * self.body_height * torch.tanh(self.offsets)
        canonical = self.points.means + offsets
        means = (A @ canonical.unsqueeze(-1)).squeeze(-1) + t
        low, high = (math.log(bound * self.body_height) for bound in self.scale_range)
        rotation = quaternion_to_rotation_matrix(functional.normalize(self.quats, dim=-1, eps=1e-6))
        axes = A @ (rotation * bounded(self.log_scales, low, high).exp().unsqueeze(-2))
        sh = self.sh[:, : (self.active_degree + 1) ** 2].expand(batch, -1, -1, -1)
        view = means  # at degree 0 a colour has no direction
        if sh.shape[-2] > 1:
            # Seen from the canonical body, as in 3DGS-Avatar: a turned arm keeps its highlights.
            view = functional.normalize(means - eye[:, None], dim=-1, eps=1e-6)
            view = functional.normalize((A.mT @ view.unsqueeze(-1)).squeeze(-1), dim=-1, eps=1e-6)
        logits = bounded(self.logit_opacities, -self.logit_bound, self.logit_bound)
        return Gaussians(
            means=means,
            quats=None,
            scales=None,
            covariances=axes @ axes.mT,
            opacities=torch.sigmoid(logits).expand(batch, -1),
            features=functional.relu(sh_to_colour(sh, view)),
        )
