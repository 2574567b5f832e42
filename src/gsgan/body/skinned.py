"""A skinned body: vertices, bones and part labels, and their transformation by a pose."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Self

import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from gsgan.body.lbs import (
    axis_angle_to_matrix,
    blend_transforms,
    check_weights,
    forward_kinematics,
    skin,
)
from gsgan.scene import BodyPose
from gsgan.utils.tensors import matvec

KEPT_BONES = 4  # number of bones per vertex whose weights' gradients are used


@dataclass(frozen=True, kw_only=True)
class SkinnedBody:
    """A skinned body with part labels, unbatched.

    Units are metres; the axes depend on the body (the free body has Z up, SMPL's have Y up); the
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
    # [V, 3] metres, the body before it is shaped
    template: Tensor | None = None

    def __post_init__(self) -> None:
        check_weights(self.bone_weight)

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """A copy on another device or with another float dtype; integers keep their dtype."""
        changes: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Tensor):
                moved = value.to(*args, **kwargs)
                if not value.is_floating_point():
                    moved = moved.to(value.dtype)
                changes[field.name] = moved
        return replace(self, **changes)

    def shares_labels(self, names: Sequence[str]) -> bool:
        """Whether these names of labels are the body's own parts."""
        own_names = self.label_names[: len(names)]
        return self.label_source == "own" and tuple(names) == own_names

    def with_labels(
        self, vertex_labels: Tensor, label_names: Sequence[str]
    ) -> Self:
        """The body with the data's labels on its vertices ``[V]``.

        Raises:
            ValueError: when there is not one label per vertex, or a label has no name.
        """
        shape = vertex_labels.shape
        minimum = vertex_labels.min()
        maximum = vertex_labels.max()
        in_range = minimum >= 0 and maximum < len(label_names)
        if shape != self.vertex_labels.shape or not in_range:
            raise ValueError(
                f"{type(self).__name__}.voted: vertex_labels must be {len(self.vertex_labels)} "
                f"numbers from 0 to {len(label_names) - 1}, got {list(shape)} from "
                f"{int(minimum)} to {int(maximum)}"
            )
        return replace(
            self,
            vertex_labels=vertex_labels.to(self.vertex_labels),
            label_names=tuple(label_names),
            label_source="vote",
        )

    def transforms(self, pose: BodyPose) -> Tensor:
        """``[B, J, 4, 4]`` world transform of each bone relative to rest.

        Raises:
            ValueError: when ``pose.theta`` has another number of joints than the body.
        """
        rotations = axis_angle_to_matrix(pose.theta)
        return forward_kinematics(
            self.joints.to(rotations),
            self.parents,
            rotations,
            pose.transl.to(rotations),
        )

    def pose(self, pose: BodyPose) -> tuple[Tensor, Tensor]:
        """Affine map of each vertex, ``A [B, V, 3, 3]`` and ``t [B, V, 3]`` (paper Sec. 3.4)."""
        return blend_transforms(
            self.transforms(pose), self.bone_index, self.bone_weight
        )

    def posed_vertices(self, pose: BodyPose) -> Tensor:
        """``[B, V, 3]`` metres, world frame."""
        A, t = self.pose(pose)
        return skin(self.vertices.to(A), A, t)


@dataclass(frozen=True, kw_only=True)
class MarkedBody(SkinnedBody):
    """A skinned body with MediaPipe's 33 pose landmarks; NaN if the body does not define one."""

    landmarks: Tensor  # [33, 3] rest positions, metres
    landmark_bone: Tensor  # [33] int64, the joint that each landmark moves with

    def posed_landmarks(self, pose: BodyPose) -> Tensor:
        """``[B, 33, 3]`` MediaPipe pose landmarks, metres, world frame."""
        return carry(self.transforms(pose), self.landmarks, self.landmark_bone)


def carry(
    transforms: Tensor, points: Tensor, bones: Tensor | None = None
) -> Tensor:
    """``[B, N, 3]``: points ``[N, 3]`` moved rigidly with their bones; None: one of each bone."""
    T = transforms if bones is None else transforms[:, bones]
    return matvec(T[..., :3, :3], points.to(T)) + T[..., :3, 3]


def vertex_normals(vertices: Tensor, faces: Tensor) -> Tensor:
    """``[V, 3]`` outward unit normals, faces weighted by their area; zero without a face."""
    # Twice the area along each face's normal, summed over the faces of a vertex.
    a, b, c = vertices[faces].unbind(1)
    face = torch.linalg.cross(b - a, c - a)
    summed = torch.zeros_like(vertices)
    for corner in faces.unbind(1):
        summed.index_add_(0, corner, face)
    return nn.functional.normalize(summed, dim=-1, eps=1e-20)


class WeightGradients(nn.Module):
    """How skinning weights change along a body's surface, for `gsgan.body.lbs.stretch_jacobian`.

    The gradients follow in the least squares sense from the differences between neighbours. They
    lie in the surface.

    Args:
        body: rest positions, faces and joints.
        chosen: ``[N]`` int64, the vertices whose weights and gradients are used.

    Source: ours.
    """

    # The gradient operator as a compressed sparse matrix, 3 rows per vertex.
    rows: Tensor
    columns: Tensor
    values: Tensor

    def __init__(self, body: SkinnedBody, chosen: Tensor) -> None:
        super().__init__()
        self.joints = len(body.joints)

        # The rows of the operator are the axes of each vertex.
        operator = surface_gradient(body.vertices, body.faces, chosen)
        buffers = {
            "rows": torch.from_numpy(operator.indptr[:-1]).long(),
            "columns": torch.from_numpy(operator.indices).long(),
            "values": torch.from_numpy(operator.data).float(),
        }
        for name, value in buffers.items():
            self.register_buffer(name, value, persistent=False)

    @torch.no_grad()
    def forward(self, index: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
        """The terms of `gsgan.body.lbs.stretch_jacobian` for these skinning weights.

        Only the `KEPT_BONES` bones of each vertex whose weights change most are used. The gradients
        of their weights are shifted to sum to zero, as those of all bones do.

        Args:
            index, weight: ``[N, n]`` bones of each chosen vertex and their weights.

        Returns:
            ``[N, KEPT_BONES]`` int64 bones, and the gradients ``[N, KEPT_BONES, 3]`` of their
            weights, per metre.
        """
        # The gradients [N, 3, J] of all bones' weights.
        weight = (weight / weight.sum(dim=1, keepdim=True)).to(self.values)
        dense = weight.new_zeros(len(weight), self.joints)
        dense.scatter_add_(1, index, weight)
        slopes = embedding_bag(
            self.columns,
            dense,
            self.rows,
            mode="sum",
            per_sample_weights=self.values,
        )
        slopes = slopes.unflatten(0, (-1, 3))

        # The largest, shifted to sum to zero.
        change = slopes.square().sum(dim=1)
        _, bones = change.topk(min(KEPT_BONES, self.joints), dim=1)
        slopes = slopes.gather(2, bones.unsqueeze(1).expand(-1, 3, -1))
        slopes = slopes - slopes.mean(dim=2, keepdim=True)
        return bones, slopes.mT.contiguous()


def surface_gradient(
    vertices: Tensor, faces: Tensor, chosen: Tensor
) -> csr_array:
    """The gradient along the surface of numbers that are known at some of its vertices.

    Args:
        vertices: ``[V, 3]`` metres.
        faces: ``[F, 3]`` int64.
        chosen: ``[N]`` int64, the vertices where the numbers are known.

    Returns:
        ``[3 N, N]``, times ``[N]`` numbers: their gradients at these vertices, axis by axis. A
        vertex without a neighbour has the gradient zero.
    """
    # Edges a to b between chosen vertices.
    x = vertices.double()
    normals = vertex_normals(x, faces)[chosen]
    a, b = neighbours_on_surface(x, faces, chosen).T
    x = x[chosen]
    count = len(chosen)
    step = x[b] - x[a]

    # Least squares in the tangent plane: (Σ step stepᵀ) gradient = Σ step (difference).
    square = x.new_zeros(count, 3, 3)
    square.index_add_(0, a, step.unsqueeze(2) * step.unsqueeze(1))
    size = (
        square.diagonal(dim1=1, dim2=2)
        .sum(dim=1)
        .clamp_min(1e-12)[:, None, None]
    )
    across = normals.unsqueeze(2) * normals.unsqueeze(1)
    square = square + size * (across + 1e-6 * torch.eye(3).to(x))
    share = torch.linalg.solve(square[a], step)  # [E, 3]
    share = share - (share * normals[a]).sum(dim=-1, keepdim=True) * normals[a]

    # A difference is the number at the edge's end less that at its start.
    rows = (3 * a.unsqueeze(1) + torch.arange(3)).flatten().numpy()
    ends = b.repeat_interleave(3).numpy()
    starts = a.repeat_interleave(3).numpy()

    # Sparse: a point depends on its few neighbours only.
    values = share.flatten().numpy()
    shape = (3 * count, count)
    plus = csr_array((values, (rows, ends)), shape)
    minus = csr_array((values, (rows, starts)), shape)
    return csr_array(plus - minus)


def neighbours_on_surface(
    vertices: Tensor, faces: Tensor, chosen: Tensor
) -> Tensor:
    """``[E, 2]`` pairs of chosen vertices, in both orders, that are next to each other.

    Each vertex belongs to the chosen one that is nearest along the edges; two chosen vertices are
    neighbours if an edge joins what belongs to them. With all vertices chosen these are the edges.
    """
    # The edges of all faces, and their lengths.
    edges = torch.cat([faces[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    start, end = edges.T
    length = (vertices[end] - vertices[start]).norm(dim=1).clamp_min(1e-9)

    # The chosen vertex that is nearest to each vertex.
    V = len(vertices)
    graph = csr_array((length.numpy(), (start.numpy(), end.numpy())), (V, V))
    _, _, nearest = dijkstra(
        graph,
        directed=False,
        indices=chosen.numpy(),
        min_only=True,
        return_predecessors=True,
    )
    nearest = torch.from_numpy(nearest).long()

    # Vertices on pieces of the mesh without a chosen vertex are not reached.
    reached = nearest >= 0
    edges = edges[reached[edges].all(dim=1)]
    place = torch.full((V,), -1)
    place[chosen] = torch.arange(len(chosen))
    pairs = place[nearest[edges]]
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return torch.cat([pairs, pairs.flip(1)]).unique(dim=0)
