"""Linear blend skinning: joint rotations to bone transforms to one affine map per vertex.

Units are metres; vectors are columns, ``x_posed = A @ x_rest + t``; batch first. Every joint's
rest frame is aligned with the world's axes: zero rotations are the rest pose.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import chain, pairwise
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from gsgan.utils.tensors import constant, matvec


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Rotation matrices ``[..., 3, 3]`` of axis-angle vectors ``[..., 3]`` in radians.

    Rodrigues' formula, and below 1e-6 squared radians its Taylor series: values and gradients are
    finite at zero rotation.
    """
    # A safe angle where the series is used: the unused branch must not give NaN
    # gradients.
    squared = (axis_angle * axis_angle).sum(-1)[..., None, None]
    is_small = squared < 1e-6
    angle = torch.where(is_small, torch.ones_like(squared), squared).sqrt()

    # R = 1 + a K + b K², with a = sin x / x and b = (1 - cos x) / x².
    a = torch.where(is_small, 1 - squared / 6, angle.sin() / angle)
    # b from the half angle: no cancellation near zero.
    half = torch.sin(angle / 2) / angle
    b = torch.where(is_small, 0.5 - squared / 24, 2 * half * half)
    K = _cross_matrix(axis_angle)
    eye = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return eye + a * K + b * (K @ K)


def shortest_turn(a: Tensor, b: Tensor) -> Tensor:
    """Axis-angle ``[..., 3]`` of the shortest rotations from unit ``a`` to ``b [..., 3]``."""
    # The cross product has the length of the angle's sine; parallel vectors
    # have no axis.
    axis = torch.linalg.cross(a, b)
    sine = axis.norm(dim=-1, keepdim=True)
    cosine = (a * b).sum(-1, keepdim=True)
    return axis * torch.atan2(sine, cosine) / sine.clamp_min(1e-6)


def left_jacobian(v: Tensor) -> Tensor:
    """``[..., 3, 3]``: the rotation, applied last, that a change of the axis-angle ``v`` adds."""
    # A safe angle where the series is used, as in `axis_angle_to_matrix`.
    squared = v.square().sum(-1)[..., None, None]
    small = squared < 1e-4
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = safe.sqrt()

    # J = 1 + a K + b K², with a = (1 - cos x) / x² and b = (x - sin x) / x³; near zero their
    # Taylor series.
    a = torch.where(small, 0.5 - squared / 24, (1 - angle.cos()) / safe)
    b = (angle - angle.sin()) / (safe * angle)
    b = torch.where(small, 1 / 6 - squared / 120, b)
    K = _cross_matrix(v)
    eye = torch.eye(3, dtype=v.dtype, device=v.device)
    return eye + a * K + b * (K @ K)


def _cross_matrix(v: Tensor) -> Tensor:
    """``[..., 3, 3]`` whose product with a vector is its cross product with ``v``."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    entries = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def kinematic_levels(parents: Sequence[int]) -> list[list[int]]:
    """Joints by depth, roots (parent -1) first; each parent comes before its children."""
    # Parents come first, so a parent's depth is known.
    depth: list[int] = []
    for parent in parents:
        depth.append(0 if parent < 0 else depth[parent] + 1)
    levels: list[list[int]] = [[] for _ in range(max(depth) + 1)]
    for joint, level in enumerate(depth):
        levels[level].append(joint)
    return levels


def forward_kinematics(
    joints: Tensor, parents: Sequence[int], rotations: Tensor, transl: Tensor
) -> Tensor:
    """World transform of each bone relative to the rest pose.

    Args:
        joints: ``[J, 3]`` rest positions, metres; or ``[B, J, 3]``, one body per pose.
        parents: parent of each joint, -1 for the root, each parent before its children.
        rotations: ``[B, J, 3, 3]`` of each joint relative to its parent.
        transl: ``[B, 3]`` metres, added after the root's rotation about its own joint.

    Returns:
        ``[B, J, 4, 4]``: a rest point x moves rigidly with bone j to ``T[:, j] @ (x, 1)``.

    Raises:
        ValueError: when the shape of rotations or transl does not match.
    """
    # Broadcasting would accept other shapes silently.
    J = len(parents)
    if rotations.ndim != 4 or rotations.shape[1:] != (J, 3, 3):
        raise ValueError(
            f"forward_kinematics: rotations must have shape [B, {J}, 3, 3], "
            f"got {list(rotations.shape)}"
        )
    if transl.shape != (len(rotations), 3):
        raise ValueError(
            f"forward_kinematics: transl must have shape [{len(rotations)}, 3], "
            f"got {list(transl.shape)}"
        )

    # A bone moves its own joint from the rest position to the posed one.
    R, position = _accumulate(joints, parents, rotations, transl)
    shift = position - R @ joints.unsqueeze(-1)
    top = torch.cat([R, shift], dim=-1)
    bottom = constant((0.0, 0.0, 0.0, 1.0), top).expand(*top.shape[:2], 1, 4)
    return torch.cat([top, bottom], dim=-2)


def _accumulate(
    joints: Tensor, parents: Sequence[int], rotations: Tensor, transl: Tensor
) -> tuple[Tensor, Tensor]:
    """World rotations ``[B, J, 3, 3]`` and positions ``[B, J, 3, 1]``, one level at a time."""
    plan = kinematic_plan(tuple(parents))

    def take(x: Tensor, index: tuple[int, ...], dim: int) -> Tensor:
        return x.index_select(dim, constant(index, x, torch.int64))

    # Joints in the order of their levels: offsets from the parent, and local rotations.
    rest = take(joints, plan.order, -2)
    offsets = (rest - take(joints, plan.parents, -2)).unsqueeze(-1)
    offsets_by_level = offsets.split(plan.level_sizes, dim=-3)
    ordered = take(rotations, plan.order, 1)
    rotations_by_level = list(ordered.split(plan.level_sizes, dim=1))

    # Roots stand at their rest position, moved by the translation.
    roots = rest[..., : plan.level_sizes[0], :].expand(len(rotations), -1, -1)
    positions = [(roots + transl.unsqueeze(1)).unsqueeze(-1)]

    # Each further level follows the level above it.
    for level, places in enumerate(plan.parent_places, start=1):
        parent_R = take(rotations_by_level[level - 1], places, 1)
        parent_position = take(positions[-1], places, 1)
        positions.append(parent_position + parent_R @ offsets_by_level[level])
        rotations_by_level[level] = parent_R @ rotations_by_level[level]

    # Back to the order of the joints.
    R = take(torch.cat(rotations_by_level, dim=1), plan.inverse, 1)
    return R, take(torch.cat(positions, dim=1), plan.inverse, 1)


class KinematicPlan(NamedTuple):
    """How the joints of a skeleton are visited, level by level from the roots."""

    level_sizes: list[int]
    order: tuple[int, ...]  # joints, level by level
    # of each joint in `order`; a root is its own parent
    parents: tuple[int, ...]
    # by level, from the second: places of the parents in the level above
    parent_places: tuple[tuple[int, ...], ...]
    inverse: tuple[int, ...]  # place of each joint in `order`


@lru_cache(maxsize=64)
def kinematic_plan(parents: tuple[int, ...]) -> KinematicPlan:
    """The plan of a skeleton with these parents, -1 for a root."""
    levels = kinematic_levels(parents)
    order = tuple(chain.from_iterable(levels))

    # A root is its own parent, so that its offset is zero.
    own_parents = [
        joint if parents[joint] < 0 else parents[joint] for joint in order
    ]

    # Each level is looked up in the level above it alone.
    parent_places = []
    for above, level in pairwise(levels):
        parent_places.append(
            tuple(above.index(parents[joint]) for joint in level)
        )
    return KinematicPlan(
        level_sizes=list(map(len, levels)),
        order=order,
        parents=tuple(own_parents),
        parent_places=tuple(parent_places),
        inverse=tuple(map(order.index, range(len(parents)))),
    )


def check_weights(bone_weight: Tensor) -> None:
    """Checks skinning weights ``[V, n]``, once, where they are stored.

    Not in :func:`blend_transforms`: reading values makes the host wait for the device, which costs
    too much per frame.

    Raises:
        ValueError: when a vertex has no weight, a negative one, or one that is not finite.
    """
    # Weights are divided by their sum, which must be positive.
    total = bone_weight.sum(-1)
    good = (total > 0) & total.isfinite() & (bone_weight >= 0).all(-1)
    if not bool(good.all()):
        raise ValueError(
            f"check_weights: bone_weight must be finite and non-negative with a positive sum for "
            f"every vertex, got {int((~good).sum())} vertices without"
        )


def blend_transforms(
    transforms: Tensor, bone_index: Tensor, bone_weight: Tensor
) -> tuple[Tensor, Tensor]:
    """The affine map of each vertex: the weighted average of its bones' transforms.

    Weights are divided by their sum first. ``A`` is a rotation only if one bone has all the
    weight: otherwise it also shears and shrinks, so shapes attached to a vertex are transformed as
    covariances, ``A Σ Aᵀ``.

    Args:
        transforms: ``[B, J, 4, 4]`` from :func:`forward_kinematics`.
        bone_index: ``[V, n]`` int64, bones of each vertex.
        bone_weight: ``[V, n]`` that passed :func:`check_weights`; values are not checked here.

    Returns:
        ``A [B, V, 3, 3]`` and ``t [B, V, 3]``.

    Source: paper Sec. 3.4, ``x_o = (Σ_b w_b ΔB_b) x_c``.
    """
    # Weights that sum to 1.
    weight = bone_weight.to(transforms.dtype)
    weight = weight / weight.sum(-1, keepdim=True)

    # One lookup averages the transforms of all poses: its table has a row for each bone.
    bones = transforms[:, :, :3].transpose(0, 1).flatten(1)
    blended = embedding_bag(
        bone_index, bones, per_sample_weights=weight, mode="sum"
    )
    affine = blended.unflatten(1, (-1, 3, 4)).transpose(0, 1)
    return affine[..., :3], affine[..., 3]


def stretch_jacobian(
    A: Tensor,
    transforms: Tensor,
    vertices: Tensor,
    bones: Tensor,
    slopes: Tensor,
    limit: float = math.inf,
) -> Tensor:
    """The Jacobian of skinning at each vertex: how the surface about it turns and stretches.

    ``A`` is the Jacobian of constant weights. Where weights change along the surface, skinning
    also pulls neighbours apart: in a high kick, vertices of the hip by centimetres, while A shrinks
    there.

    Args:
        A: ``[B, V, 3, 3]`` from :func:`blend_transforms`.
        transforms: ``[B, J, 4, 4]`` from :func:`forward_kinematics`.
        vertices: ``[V, 3]`` at rest.
        bones, slopes: from :class:`gsgan.body.skinned.WeightGradients`.
        limit: largest Frobenius norm of the sum, which is scaled down to it.

    Returns:
        ``[B, V, 3, 3]``: ``A + Σ_b (ΔB_b x_c) ∇w_bᵀ``.

    Source: Tarini et al., Accurate and Efficient Lighting for Skinned Models, 2014.
    """
    # Gradients sum to zero: less the root's place, numbers are as small as distances of bones.
    turns, places = transforms[:, :, :3].split((3, 1), dim=-1)
    places = places - places[:, :1]

    # Where each bone carries the vertex, [B, V, KEPT, 3].
    moved = turns[:, bones] @ vertices.to(turns)[:, None, :, None]
    moved = (moved + places[:, bones]).squeeze(-1)
    pulled = moved.mT @ slopes.to(moved)

    # An infinite limit would be divided by itself.
    if math.isfinite(limit):
        norm = torch.linalg.matrix_norm(pulled, keepdim=True)
        pulled = pulled * (limit / norm.clamp_min(limit))
    return A + pulled


def skin(vertices: Tensor, A: Tensor, t: Tensor) -> Tensor:
    """Posed vertices ``[B, V, 3]``: rest ``[V, 3]`` (or a batch) by ``A [B,V,3,3], t [B,V,3]``."""
    return matvec(A, vertices) + t
