"""The novel-view segmentation module: a skinned body splatted into part probabilities S."""

from __future__ import annotations

import math

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor, nn
from torch.nn import functional

from gsgan.body import SkinnedBody
from gsgan.model.skinned_points import SkinnedPoints
from gsgan.precision import full_precision
from gsgan.scene import BodyPose, Camera, Gaussians
from gsgan.splat import accuracy as named_accuracy
from gsgan.splat import rasterise

IGNORE = 255


class Segmentation(nn.Module):
    """Canonical Gaussians on a body's vertices, moved by LBS, rendered as class probabilities.

    Learned: quats, scales, opacities. Fixed: positions, skinning weights, the one-hot class of
    each vertex. Where skinning weights mix, the blend is no rotation, so the deformed shape is
    kept as a covariance.

    Args:
        body: vertices, weights, joints and part labels.
        points: vertices used, spread evenly over the surface; None for all.
        opacity: initial opacity.
        scale: initial standard deviation, as a share of the distance to the nearest neighbour.
        accuracy: the rasteriser's settings.

    Source: paper Sec. 3.4; method.md § 3.
    """

    one_hot: Tensor

    def __init__(
        self,
        body: SkinnedBody,
        *,
        points: int | None = None,
        opacity: float = 0.9,
        scale: float = 0.7,
        accuracy: str = "standard",
    ) -> None:
        super().__init__()
        self.accuracy = named_accuracy(accuracy)
        self.points = SkinnedPoints(body, points)
        labels = body.vertex_labels[self.points.chosen].long()
        self.classes = len(body.label_names)  # background included
        one_hot = functional.one_hot(labels, self.classes)[:, 1:].float()
        self.register_buffer("one_hot", one_hot, persistent=False)
        self.quats = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(labels), 1))
        spacing = self.points.spacing
        self.log_scales = nn.Parameter((scale * spacing).log().unsqueeze(-1).repeat(1, 3))
        logit = math.log(opacity / (1 - opacity))
        self.logit_opacities = nn.Parameter(torch.full((len(labels),), logit))

    def gaussians(self, pose: BodyPose) -> Gaussians:
        """The body's Gaussians in pose: covariances A Σ Aᵀ, features = one-hot class."""
        A, t = self.points.blend(pose)
        batch = A.shape[0]
        rotation = quaternion_to_rotation_matrix(functional.normalize(self.quats, dim=-1, eps=1e-6))
        axes = A @ (rotation * self.log_scales.exp().unsqueeze(-2))
        return Gaussians(
            means=(A @ self.points.means.unsqueeze(-1)).squeeze(-1) + t,
            quats=None,
            scales=None,
            covariances=axes @ axes.mT,
            opacities=torch.sigmoid(self.logit_opacities).expand(batch, -1),
            features=self.one_hot.expand(batch, -1, -1),
        )

    def forward(self, pose: BodyPose, camera: Camera) -> Tensor:
        """S ``[B, classes, H, W]``: probabilities, channel 0 the background (1 - alpha)."""
        with full_precision(pose.theta):
            raster = rasterise(self.gaussians(pose), camera, settings=self.accuracy)
        return torch.cat([(1 - raster.alpha).clamp_min(0), raster.features], dim=1)


def segmentation_loss(segmentation: Tensor, labels: Tensor, floor: float = 1e-6) -> Tensor:
    """Cross-entropy of rendered probabilities: mean of -log(P of the true class + floor).

    The maps are probabilities already, so there is no softmax. Pixels labelled 255 are left out;
    with no other pixel the loss is 0.

    Args:
        segmentation: ``[B, classes, H, W]``.
        labels: ``[B, H, W]`` int64.
        floor: added inside the logarithm, so that a class never hit still has a gradient.

    Source: method.md § 3, § 10.
    """
    log = (segmentation + floor).log()
    total = functional.nll_loss(log, labels, ignore_index=IGNORE, reduction="sum")
    return total / (labels != IGNORE).sum().clamp_min(1)
