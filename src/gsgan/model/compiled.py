"""Parts of Ψ and of the generator's style in compiled code, on CPUs.

`Deformation.compose` and `Style.forward` call them, and define the same results by tensor
operations.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsgan.splat import build, native

RESIDUALS = 11  # mean 3, quaternion 4, scale 3, opacity 1
OUTPUTS = ("means", "covariances", "opacities")
INPUTS = ("raw", "means", "frames", "scales", "valid")
_GeometryJob = build.job_type(
    ("count", "threads", "stride"),
    ("mean_bound", "unit", "scale_low", "scale_high", "logit", "logit_bound"),
    (*INPUTS, *(f"out_{name}" for name in OUTPUTS), *(f"g_{name}" for name in OUTPUTS), "d_raw"),
)
STYLED = ("h", "modulation", "out", "g", "d_h", "d_modulation")
_StyleJob = build.job_type(("rows", "C", "threads"), ("floor", "slope"), STYLED)


def has_geometry(raw: Tensor, *fixed: Tensor) -> bool:
    """Whether `geometry` can be used: on a CPU, where only ``raw`` needs a gradient."""
    return (
        raw.device.type == "cpu"
        and raw.dtype in build.DTYPES
        and not any(x.requires_grad or x.dtype not in (raw.dtype, torch.bool) for x in fixed)
        and native.available()
    )


def geometry(
    raw: Tensor,
    means: Tensor,
    frames: Tensor,
    scales: Tensor,
    valid: Tensor,
    numbers: tuple[float, ...],
) -> tuple[Tensor, Tensor, Tensor]:
    """Means, covariances and opacities of Ĝ; differentiable once, in ``raw``.

    Args:
        raw: ``[B, N, 11]`` residuals of mean, quaternion, scale and opacity.
        means, frames, scales, valid: of `gsgan.skeleton.Points`, without gradient.
        numbers: bound of the means in metres (0: none), metres of a residual of 1 without a bound,
            least and largest logarithm of a scale, the opacity's logit and its bound.

    Returns:
        ``[B, N, 3]``, ``[B, N, 3, 3]``, ``[B, N]``.
    """
    return _Geometry.apply(raw, means, frames, scales, valid, numbers)  # type: ignore[no-any-return]


def has_style(rows: Tensor, modulation: Tensor) -> bool:
    """Whether `style` can be used: on a CPU, with equal dtypes."""
    return (
        rows.device.type == "cpu"
        and rows.dtype == modulation.dtype
        and rows.dtype in build.DTYPES
        and native.available()
    )


def style(rows: Tensor, modulation: Tensor, floor: float, slope: float) -> Tensor:
    """``leaky_relu(unit * (1 + scale) + shift)``, unit the normalised channels of each pixel.

    Convention: differentiable once; the same result with any number of threads.

    Args:
        rows: ``[B, H, W, C]``.
        modulation: ``[B, H, W, 2 C]`` scales, then shifts.
        floor: added to the mean square.
        slope: of the activation below 0.
    """
    return _Style.apply(rows, modulation, floor, slope)  # type: ignore[no-any-return]


class _Geometry(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        raw, *fixed, numbers = arguments
        B, N, _ = raw.shape
        outputs = raw.new_empty(B, N, 3), raw.new_empty(B, N, 3, 3), raw.new_empty(B, N)
        job, _held = _geometry_job(raw, fixed, numbers)
        build.point(job, [f"out_{name}" for name in OUTPUTS], outputs)
        build.function("compose", raw.dtype)(ctypes.byref(job))
        ctx.save_for_backward(raw, *fixed)
        ctx.numbers = numbers
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        raw, *fixed = ctx.saved_tensors
        job, _held = _geometry_job(raw, fixed, ctx.numbers)
        incoming = [None if g is None else g.contiguous() for g in grads]
        d_raw = raw.new_empty(*raw.shape[:2], RESIDUALS)
        build.point(job, [*(f"g_{name}" for name in OUTPUTS), "d_raw"], [*incoming, d_raw])
        build.function("compose_backward", raw.dtype)(ctypes.byref(job))
        return d_raw, *[None] * 5


def _geometry_job(
    raw: Tensor, fixed: list[Tensor], numbers: tuple[float, ...]
) -> tuple[ctypes.Structure, list[Tensor]]:
    """The job without its outputs, and the tensors it points to."""
    rows = raw.detach()
    if rows.stride(-1) != 1 or rows.stride(0) != rows.shape[1] * rows.stride(1):
        rows = rows.contiguous()
    held = [rows, *(x.detach().contiguous() for x in fixed)]
    job = _GeometryJob(rows.shape[0] * rows.shape[1], build.threads(), rows.stride(1), *numbers)
    build.point(job, INPUTS, held)
    return job, held


class _Style(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, h: Tensor, modulation: Tensor, floor: float, slope: float) -> Tensor:
        h, modulation = h.contiguous(), modulation.contiguous()
        out = torch.empty_like(h)
        ctx.sizes = h.shape[:-1].numel(), h.shape[-1], build.threads(), floor, slope
        job = _StyleJob(*ctx.sizes)
        build.point(job, STYLED[:3], [h, modulation, out])
        build.function("style", h.dtype)(ctypes.byref(job))
        ctx.save_for_backward(h, modulation, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        h, modulation, out = ctx.saved_tensors
        grads = [torch.empty_like(h), torch.empty_like(modulation)]
        held = [h, modulation, out, grad.contiguous(), *grads]
        job = _StyleJob(*ctx.sizes)
        build.point(job, STYLED, held)
        build.function("style_backward", h.dtype)(ctypes.byref(job))
        return *grads, None, None
