"""The continuous 6D representation of a rotation: its first two columns."""

import torch
from torch import Tensor

from gsgan.utils.tensors import squared_norm


def rotation_to_6d(R: Tensor) -> Tensor:
    """The first two columns of a rotation, one after the other.

    Args:
        R: ``[..., 3, 3]`` rotations.

    Returns:
        ``[..., 6]``: column 0, then column 1.

    Source: Zhou et al. 2019, used for the pose code of paper Sec. 3.5; column order is ours.
    """
    return R[..., :2].transpose(-1, -2).flatten(-2)


def rotation_from_6d(x: Tensor, eps: float = 1e-5) -> Tensor:
    """The rotation nearest to two columns, by Gram-Schmidt.

    The columns need not be unit or orthogonal. A first column shorter than ``eps`` is
    replaced by the x axis; a second one whose part orthogonal to the first is shorter than ``eps``
    times its own length (or than ``eps``) by the axis farthest from the first. The result is always
    a rotation with a finite gradient; the gradient of replaced columns is zero.

    Args:
        x: ``[..., 6]``, column 0 then column 1.
        eps: length below which a column is replaced.

    Returns:
        ``[..., 3, 3]`` with det +1.

    Raises:
        ValueError: when the last dimension is not 6.
    """
    if x.shape[-1] != 6:
        raise ValueError(
            f"rotation_from_6d: x must have shape [..., 6], got {list(x.shape)}"
        )

    # The first column, or the x axis.
    a = x[..., :3]
    b = x[..., 3:]
    x_axis = torch.eye(3, dtype=x.dtype, device=x.device)[0].expand_as(a)
    is_short = squared_norm(a) < eps**2
    first = unit(torch.where(is_short, x_axis, a))

    # The second column's part orthogonal to the first, or an axis orthogonal to it.
    part = across(first, b)
    length2 = squared_norm(b).clamp_min(1.0)
    unusable = squared_norm(part) < eps**2 * length2
    second = unit(torch.where(unusable, orthogonal_to(first.detach()), part))
    # Once more: after cancellation the first pass leaves a part along the first column.
    second = unit(across(first, second))
    return torch.stack(
        [first, second, torch.linalg.cross(first, second)], dim=-1
    )


def orthogonal_to(axis: Tensor) -> Tensor:
    """``[..., 3]`` unit vectors orthogonal to unit vectors: the world axis farthest from each."""
    # The axis with the smallest component, as a one-hot vector.
    farthest = axis.abs().argmin(dim=-1, keepdim=True)
    world_axis = torch.zeros_like(axis).scatter(-1, farthest, 1.0)
    return unit(across(axis, world_axis))


def across(axis: Tensor, v: Tensor) -> Tensor:
    """The part of v orthogonal to a unit ``axis``."""
    return v - axis * (axis * v).sum(-1, keepdim=True)


def unit(v: Tensor) -> Tensor:
    """v divided by its length."""
    return v * squared_norm(v).rsqrt()
