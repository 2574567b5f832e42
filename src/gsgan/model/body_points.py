"""G on a skinned body: fixed points of its surface, for data with a body pose that fits."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gsgan.body import SkinnedBody
from gsgan.body.skinned import vertex_normals
from gsgan.model.skinned_points import SkinnedPoints
from gsgan.scene import BodyPose
from gsgan.skeleton import Points

NORMAL_FLOOR = 1e-2  # below it rounding errors dominate where skinning is flat


class BodyPoints(nn.Module):
    """Replaces densify: each point moves with its vertex by linear blend skinning.

    A body pose holds what 33 landmarks lack: how the trunk bends and forearms turn. Ψ then learns
    shape, colour and pose-dependent change, not where the surface is.

    Args:
        body: vertices, weights and joints.
        body_height: metres, the length scale of Ψ's input.
        points: vertices used, spread evenly over the surface; None for all.
        sigma: initial standard deviation, as a share of the distance to the nearest neighbour.

    Raises:
        ValueError: on a number out of range.

    Source: ours; the paper's G is Alg. 1's (`gsgan.skeleton.Densify`).
    """

    rest_points: Tensor
    rest_normals: Tensor
    part_id: Tensor

    def __init__(
        self,
        body: SkinnedBody,
        body_height: float,
        *,
        points: int | None = None,
        sigma: float = 0.7,
    ) -> None:
        super().__init__()
        if sigma <= 0:
            raise ValueError(f"BodyPoints: sigma must be positive, got {sigma}")
        self.points, self.sigma = SkinnedPoints(body, points), sigma
        rest = (self.points.means - self.points.means.mean(dim=0)) / body_height
        self.register_buffer("rest_points", rest, persistent=False)
        normals = vertex_normals(body.vertices.float(), body.faces)[self.points.chosen]
        self.register_buffer("rest_normals", normals, persistent=False)
        self.register_buffer("part_id", torch.arange(len(self.points)), persistent=False)

    @property
    def n_points(self) -> int:
        """N."""
        return len(self.points)

    def forward(self, pose: BodyPose) -> Points:
        """G in pose; each point is its own part, its frame the linear part of its skinning.

        Args:
            pose: B poses of the body.
        """
        A, t = self.points.blend(pose)
        scales = (self.sigma * self.points.spacing).expand(len(A), -1)
        return Points(
            means=(A @ self.points.means.unsqueeze(-1)).squeeze(-1) + t,
            rotations=A,
            origins=t,
            scales=scales,
            valid=torch.ones_like(scales, dtype=torch.bool),
            part_id=self.part_id,
            normals=moved_normals(A, self.rest_normals),
        )


def moved_normals(A: Tensor, normals: Tensor) -> Tensor:
    """``[B, N, 3]`` normals of a surface that linear maps ``A`` ``[B, N, 3, 3]`` move.

    By the cofactors: det(A) A⁻ᵀ without the division. Where skinning flattens a point's
    neighbourhood the normal fades to zero, from about NORMAL_FLOOR of the area at rest.
    """
    x, y, z = A.unbind(-1)
    cofactors = [torch.linalg.cross(a, b) for a, b in ((y, z), (z, x), (x, y))]
    moved = (torch.stack(cofactors, dim=-1) @ normals.unsqueeze(-1)).squeeze(-1)
    return moved * torch.rsqrt(moved.square().sum(-1, keepdim=True) + NORMAL_FLOOR**2)
