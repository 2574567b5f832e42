"""The novel-view segmentation module: a skinned body splatted into part probabilities S."""

from __future__ import annotations

import math

import torch
from kornia.geometry.conversions import quaternion_to_rotation_matrix
from torch import Tensor, nn
from torch.nn import functional

from gsgan.body import SkinnedBody, axis_angle_to_matrix, blend_transforms, forward_kinematics
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

    joints: Tensor
    bone_index: Tensor
    bone_weight: Tensor
    means: Tensor
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
        self.accuracy, self.parents = named_accuracy(accuracy), body.parents
        vertices = body.vertices.float()
        count = len(vertices) if points is None else min(points, len(vertices))
        chosen = farthest_points(vertices, count)
        self.register_buffer("joints", body.joints.float(), persistent=False)
        self.register_buffer("bone_index", body.bone_index[chosen], persistent=False)
        self.register_buffer("bone_weight", body.bone_weight[chosen].float(), persistent=False)
        self.register_buffer("means", vertices[chosen], persistent=False)
        labels = body.vertex_labels[chosen].long()
        self.classes = len(body.label_names)  # background included
        one_hot = functional.one_hot(labels, self.classes)[:, 1:].float()
        self.register_buffer("one_hot", one_hot, persistent=False)
        self.quats = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1))
        spacing = _nearest_distance(self.means)
        self.log_scales = nn.Parameter((scale * spacing).log().unsqueeze(-1).repeat(1, 3))
        logit = math.log(opacity / (1 - opacity))
        self.logit_opacities = nn.Parameter(torch.full((count,), logit))

    def gaussians(self, pose: BodyPose) -> Gaussians:
        """The body's Gaussians in pose: covariances A Σ Aᵀ, features = one-hot class."""
        bones = forward_kinematics(
            self.joints, self.parents, axis_angle_to_matrix(pose.theta), pose.transl
        )
        A, t = blend_transforms(bones, self.bone_index, self.bone_weight)
        batch = A.shape[0]
        rotation = quaternion_to_rotation_matrix(functional.normalize(self.quats, dim=-1, eps=1e-6))
        axes = A @ (rotation * self.log_scales.exp().unsqueeze(-2))
        return Gaussians(
            means=(A @ self.means.unsqueeze(-1)).squeeze(-1) + t,
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


def farthest_points(vertices: Tensor, count: int) -> Tensor:
    """``[count]`` indices of vertices far from each other, the first one first.

    Meshes are dense in faces and hands; a subset in list order would leave arms and legs thin.

    Args:
        vertices: ``[V, 3]``.
        count: at most V; V keeps the mesh's own order.
    """
    if count == len(vertices):
        return torch.arange(count)
    chosen = torch.zeros(count, dtype=torch.long)
    nearest = torch.full((len(vertices),), math.inf)
    for i in range(1, count):
        nearest = torch.minimum(nearest, (vertices - vertices[chosen[i - 1]]).square().sum(-1))
        chosen[i] = nearest.argmax()
    return chosen


def _nearest_distance(points: Tensor, chunk: int = 1024) -> Tensor:
    """``[V]`` metres from each point to its nearest other point; coincident points get 1e-4."""
    nearest = []
    for start in range(0, len(points), chunk):
        distance = torch.cdist(points[start : start + chunk], points)
        rows = torch.arange(len(distance))
        distance[rows, rows + start] = math.inf
        nearest.append(distance.amin(dim=1))
    return torch.cat(nearest).clamp_min(1e-4)
