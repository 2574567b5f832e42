"""The continuous 6D form of a rotation: its first two columns."""

from __future__ import annotations

import torch
from torch import Tensor


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

    Convention: the columns need not be unit or orthogonal. A first column shorter than ``eps`` is
    taken as the x axis; a second whose part across the first is shorter than ``eps`` times its own
    length (or than ``eps``) gives way to the axis least along the first. The result is a rotation
    and the gradient is finite in every case; in the replaced parts the gradient is zero.

    Args:
        x: ``[..., 6]``, column 0 then column 1.
        eps: below which a column says nothing.

    Returns:
        ``[..., 3, 3]`` with det +1.

    Raises:
        ValueError: when the last dimension is not 6.
    """
    if x.shape[-1] != 6:
        raise ValueError(f"rotation_from_6d: x must have shape [..., 6], got {list(x.shape)}")
    a, b = x[..., :3], x[..., 3:]
    x_axis = torch.eye(3, dtype=x.dtype, device=x.device)[0].expand_as(a)
    a = torch.where((a.square().sum(-1, keepdim=True) < eps**2), x_axis, a)
    first = _unit(a)

    across = b - first * (first * b).sum(-1, keepdim=True)
    length2 = b.square().sum(-1, keepdim=True).clamp_min(1.0)
    unusable = across.square().sum(-1, keepdim=True) < eps**2 * length2
    across = torch.where(unusable, orthogonal_to(first.detach()), across)
    second = _unit(across)
    # once more: after cancellation the first pass leaves a part along the first column
    second = _unit(second - first * (first * second).sum(-1, keepdim=True))
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def orthogonal_to(unit: Tensor) -> Tensor:
    """``[..., 3]`` unit vectors across unit vectors: the axis least along each, made orthogonal."""
    least = unit.abs().argmin(dim=-1, keepdim=True)
    axis = torch.zeros_like(unit).scatter(-1, least, 1.0)
    return _unit(axis - unit * (unit * axis).sum(-1, keepdim=True))


def _unit(v: Tensor) -> Tensor:
    return v * v.square().sum(-1, keepdim=True).rsqrt()
