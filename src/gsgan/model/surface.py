"""The ``lbs_splat`` baseline: Gaussians on the body's surface, moved by linear blend skinning."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gsgan.body import SkinnedBody, skin
from gsgan.model.body_points import SkinnedGaussians
from gsgan.model.residual_gaussians import clamp_soft, colour_from
from gsgan.scene import BodyPose, Gaussians
from gsgan.utils.checks import one_of


class SurfaceGaussians(SkinnedGaussians):
    """Canonical Gaussians with learned offsets from the body, shapes and colours.

    Only the skinning depends on the pose, as in GauHuman and 3DGS-Avatar without their
    pose-dependent networks.

    Args:
        body: vertices, weights and joints.
        stature: metres, the length scale of the bounds.
        points: vertices used, spread evenly over the surface; None for all.
        sh_degree: 0 (no view dependence) to 3.
        opacity, scale: initial values, see `SkinnedGaussians`.
        mean_bound: largest distance of a mean from its vertex, body heights.
        scale_min, scale_max: body heights, the range of every scale.
        scale_spacings: replaces scale_max where given: the largest scale in median distances of
            neighbouring points.
        logit_bound: opacity logits are kept within ± this.

    Source: the baselines of the paper's Sec. 4.
    """

    def __init__(
        self,
        body: SkinnedBody,
        stature: float,
        *,
        points: int | None = None,
        sh_degree: int = 0,
        opacity: float = 0.5,
        scale: float = 0.7,
        mean_bound: float = 0.25,
        scale_min: float = 1e-4,
        scale_max: float = 0.06,
        scale_spacings: float | None = None,
        logit_bound: float = 8.0,
    ) -> None:
        super().__init__(body, points, opacity, scale)
        one_of("model.surface: sh_degree", sh_degree, range(4))
        count = len(self.points)

        # Colour is splatted alone, without other features.
        self.features = 0
        self.sh_degree = sh_degree
        self.stature = float(stature)
        # raised during training; higher degrees are not computed
        self.active_degree = sh_degree

        # Bounds of what is learned.
        self.mean_bound = mean_bound
        self.logit_bound = logit_bound
        if scale_spacings is not None:
            spacing = float(self.points.spacing.median())
            scale_max = scale_spacings * spacing / self.stature
        self.scale_range = (scale_min, scale_max)

        # Means start at their vertices, colours at grey.
        self.offsets = nn.Parameter(torch.zeros(count, 3))
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
        # The means: offsets at rest within a bound, then LBS.
        A, t = self.points.blend(pose)
        offsets = self.mean_bound * self.stature * torch.tanh(self.offsets)
        means = skin(self.points.means + offsets, A, t)

        # Bounds of the scales in metres, and the harmonics that are active.
        low, high = (
            math.log(bound * self.stature) for bound in self.scale_range
        )
        sh = self.sh[:, : (self.active_degree + 1) ** 2].expand(
            len(A), -1, -1, -1
        )
        return self.deform(
            A,
            means,
            clamp_soft(self.log_scales, low, high),
            clamp_soft(
                self.logit_opacities, -self.logit_bound, self.logit_bound
            ),
            colour_from(eye, means, A, sh),
        )


@dataclass(frozen=True)
class SurfaceGaussiansSettings:
    """Settings of `SurfaceGaussians`: conf/model/lbs_splat.yaml."""

    points: int | None
    opacity: float
    scale: float
    mean_bound: float
    scale_min: float
    scale_max: float
    scale_spacings: float | None
    logit_bound: float

    def build(
        self, body: SkinnedBody, stature: float, sh_degree: int
    ) -> SurfaceGaussians:
        """The Gaussians on a person's body."""
        return SurfaceGaussians(
            body, stature, sh_degree=sh_degree, **vars(self)
        )
