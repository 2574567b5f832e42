"""A skinned body: vertices, bones and part labels, and their transformation by a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Self

import torch
from torch import Tensor

from gsgan.body.lbs import (
    axis_angle_to_matrix,
    blend_transforms,
    check_weights,
    forward_kinematics,
    skin,
)
from gsgan.scene import BodyPose

KEPT = 4  # bones whose weights change most
SMOOTHED = 3  # averages over a vertex's edges before its weights' gradients: weights have steps


@dataclass(frozen=True, kw_only=True)
class SkinnedBody:
    """A skinned body with part labels, unbatched.

    Convention: metres; the axes depend on the body (the free body has Z up, SMPL's have Y up); the
    root rotates about its own joint. ``label_source`` is the source of a vertex's part: "own", the
    body's definition; "guess", its joint, where the true part depends on the clothes; "vote", the
    data's label images. Subsets of vertices are chosen on ``template``, so that they do not depend
    on how a processor rounds a person's shape.

    Raises:
        ValueError: when a vertex has no skinning weight, or one that is negative or not finite.
    """

    vertices: Tensor  # [V, 3] rest positions, metres
    faces: Tensor  # [F, 3] int64, counter-clockwise seen from outside
    bone_index: Tensor  # [V, n] int64
    bone_weight: Tensor  # [V, n], rows sum to 1
    joints: Tensor  # [J, 3] rest positions, metres
    parents: tuple[int, ...]  # of each joint, -1 for the root
    joint_names: tuple[str, ...]
    vertex_labels: Tensor  # [V] int64 part of each vertex, see label_names
    label_names: tuple[str, ...]  # of each part, background first
    label_source: Literal["own", "guess", "vote"] = "own"
    template: Tensor | None = None  # [V, 3] metres, the body before it is shaped

    def __post_init__(self) -> None:
        check_weights(self.bone_weight)

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """A copy on another device or with another float dtype; integers keep their dtype."""
        changes: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                moved = value.to(*args, **kwargs)
                floating = value.is_floating_point()
                changes[field.name] = moved if floating else moved.to(value.dtype)
        return replace(self, **changes)

    def shares_labels(self, names: Sequence[str]) -> bool:
        """Whether these names of labels are the body's own parts."""
        return self.label_source == "own" and tuple(names) == self.label_names[: len(names)]

    def voted(self, vertex_labels: Tensor, label_names: Sequence[str]) -> Self:
        """The body with the data's labels on its vertices ``[V]``.

        Raises:
            ValueError: when there is not one label per vertex, or a label has no name.
        """
        shape, least, most = vertex_labels.shape, vertex_labels.min(), vertex_labels.max()
        if shape != self.vertex_labels.shape or least < 0 or most >= len(label_names):
            raise ValueError(
                f"{type(self).__name__}.voted: vertex_labels must be {len(self.vertex_labels)} "
                f"numbers from 0 to {len(label_names) - 1}, got {list(vertex_labels.shape)} from "
                f"{int(least)} to {int(most)}"
            )
        labels = vertex_labels.to(self.vertex_labels)
        names = tuple(label_names)
        return replace(self, vertex_labels=labels, label_names=names, label_source="vote")

    def transforms(self, pose: BodyPose) -> Tensor:
        """``[B, J, 4, 4]`` world transform of each bone relative to rest.

        Raises:
            ValueError: when ``pose.theta`` has another number of joints than the body.
        """
        rotations = axis_angle_to_matrix(pose.theta)
        return forward_kinematics(
            self.joints.to(rotations), self.parents, rotations, pose.transl.to(rotations)
        )

    def pose(self, pose: BodyPose) -> tuple[Tensor, Tensor]:
        """Affine map of each vertex, ``A [B, V, 3, 3]`` and ``t [B, V, 3]`` (paper Sec. 3.4)."""
        return blend_transforms(self.transforms(pose), self.bone_index, self.bone_weight)

    def posed_vertices(self, pose: BodyPose) -> Tensor:
        """``[B, V, 3]`` metres, world frame."""
        A, t = self.pose(pose)
        return skin(self.vertices.to(A), A, t)


@dataclass(frozen=True, kw_only=True)
class MarkedBody(SkinnedBody):
    """A skinned body with MediaPipe's 33 pose landmarks; NaN where the body does not define one."""

    landmarks: Tensor  # [33, 3] rest positions, metres
    landmark_bone: Tensor  # [33] int64, the joint that each landmark moves with

    def posed_landmarks(self, pose: BodyPose) -> Tensor:
        """``[B, 33, 3]`` MediaPipe pose landmarks, metres, world frame."""
        return carry(self.transforms(pose), self.landmarks, self.landmark_bone)


def carry(transforms: Tensor, points: Tensor, bones: Tensor | None = None) -> Tensor:
    """``[B, N, 3]``: points ``[N, 3]`` moved rigidly with their bones; None: one of each bone."""
    T = transforms if bones is None else transforms[:, bones]
    return (T[..., :3, :3] @ points.to(T)[..., None]).squeeze(-1) + T[..., :3, 3]


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """``[V, 3]`` outward unit normals, faces weighted by their area; zero where there is none."""
    a, b, c = vertices[faces].unbind(1)
    face = torch.linalg.cross(b - a, c - a)
    summed = torch.zeros_like(vertices)
    for corner in faces.unbind(1):
        summed.index_add_(0, corner, face)
    return torch.nn.functional.normalize(summed, dim=-1, eps=1e-20)


def stretch_terms(body: SkinnedBody) -> tuple[Tensor, Tensor]:
    """The terms of `gsgan.body.lbs.stretched`: how skinning weights change along the surface.

    Their gradients follow in the least squares sense from the differences along a vertex's edges,
    for the bones whose weights change most. They lie in the surface, and their sum is zero.

    Returns:
        ``[3 V, 4 KEPT]``: of each vertex and axis, columns of the bones' transforms, int64
        from 0 to 4 J, and their factors: products of the vertex's position and the gradients.

    Source: ours.
    """
    x, faces = body.vertices.double(), body.faces
    count, bones = len(x), len(body.joints)
    dense = x.new_zeros(count, bones).scatter_add_(1, body.bone_index, body.bone_weight.double())
    dense = dense / dense.sum(1, keepdim=True)
    edges = torch.cat([faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    a, b = torch.cat([edges, edges.flip(1)]).unique(dim=0).T
    step, normals = x[b] - x[a], vertex_normals(x, faces)
    degree = torch.bincount(a, minlength=count).clamp_min(1).to(x).unsqueeze(1)
    smooth = dense
    for _ in range(SMOOTHED):
        smooth = (smooth + torch.zeros_like(smooth).index_add_(0, a, smooth[b]) / degree) / 2
    square = x.new_zeros(count, 3, 3).index_add_(0, a, step.unsqueeze(2) * step.unsqueeze(1))
    size = square.diagonal(dim1=1, dim2=2).sum(1).clamp_min(1e-12)[:, None, None]
    square = square + size * (
        normals.unsqueeze(2) * normals.unsqueeze(1) + 1e-6 * torch.eye(3).to(x)
    )
    moved = step.unsqueeze(2) * (smooth[b] - smooth[a]).unsqueeze(1)
    slope = torch.linalg.solve(square, x.new_zeros(count, 3, bones).index_add_(0, a, moved)).mT
    slope = slope - (slope @ normals.unsqueeze(-1)) * normals.unsqueeze(1)
    index = slope.norm(dim=-1).topk(min(KEPT, bones), dim=1).indices
    slope = slope.gather(1, index.unsqueeze(-1).expand(-1, -1, 3))
    slope = slope - slope.mean(1, keepdim=True)
    homogeneous = torch.cat([x, torch.ones_like(x[:, :1])], dim=1)
    factors = slope.mT.unsqueeze(-1) * homogeneous[:, None, None]
    columns = (4 * index.unsqueeze(-1) + torch.arange(4))[:, None].expand_as(factors)
    return columns.flatten(2).flatten(0, 1), factors.flatten(2).flatten(0, 1).float()
