"""Canonical points on a skinned body, moved by linear blend skinning."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from gsgan.body import SkinnedBody, axis_angle_to_matrix, blend_transforms, forward_kinematics
from gsgan.scene import BodyPose


class SkinnedPoints(nn.Module):
    """Points spread evenly over a body's vertices, moved with a pose.

    Args:
        body: vertices, weights and joints.
        count: vertices used, spread evenly over the surface; None for all.

    Raises:
        ValueError: on a count below 1.

    Source: paper Sec. 3.4.
    """

    joints: Tensor
    bone_index: Tensor
    bone_weight: Tensor
    means: Tensor
    chosen: Tensor
    spacing: Tensor

    def __init__(self, body: SkinnedBody, count: int | None = None) -> None:
        super().__init__()
        if count is not None and count < 1:
            raise ValueError(f"SkinnedPoints: points must be at least 1, or null, got {count}")
        vertices = body.vertices.float()
        every = len(vertices)
        chosen = farthest_points(vertices, every if count is None else min(count, every))
        self.parents = body.parents
        means = vertices[chosen]
        for name, value in {
            "joints": body.joints.float(),
            "bone_index": body.bone_index[chosen],
            "bone_weight": body.bone_weight[chosen].float(),
            "means": means,
            "chosen": chosen,
            "spacing": _nearest_distance(means),
        }.items():
            self.register_buffer(name, value, persistent=False)

    def __len__(self) -> int:
        return len(self.means)

    def blend(self, pose: BodyPose) -> tuple[Tensor, Tensor]:
        """The affine map of each point: ``A [B, N, 3, 3]`` and ``t [B, N, 3]``.

        A blends rotations and is none itself: transform shapes as covariances ``A Σ Aᵀ``.
        """
        bones = forward_kinematics(
            self.joints, self.parents, axis_angle_to_matrix(pose.theta), pose.transl
        )
        return blend_transforms(bones, self.bone_index, self.bone_weight)


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
