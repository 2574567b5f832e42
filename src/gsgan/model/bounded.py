"""A clamp with a gradient back into its range."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


class _Bounded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, low: float, high: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.bounds = low, high
        return x.clamp(low, high)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        (x,) = ctx.saved_tensors
        low, high = ctx.bounds
        outwards = ((x > high) & (grad < 0)) | ((x < low) & (grad > 0))
        return grad.masked_fill(outwards, 0.0), None, None


def bounded(x: Tensor, low: float, high: float) -> Tensor:
    """``x`` clamped to [low, high], with a gradient that leads back.

    Convention: beyond a bound the gradient is 0 where a step against it would lead further out, and
    passes where it leads back in. A plain clamp has none there: a parameter that once crossed the
    bound would never learn again.

    Source: ours.
    """
    bounded_x: Tensor = _Bounded.apply(x, low, high)
    return bounded_x
