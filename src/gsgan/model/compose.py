"""The geometry of Ĝ from Ψ's raw residuals, compiled for CPUs."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from gsgan.splat import build, native

RESIDUALS = 11  # mean 3, quaternion 4, scale 3, opacity 1
_INPUTS = ("raw", "means", "frames", "scales", "valid")
_OUTPUTS = ("means", "covariances", "opacities")


_Job = build.job_type(
    ("count", "threads", "stride"),
    ("mean_bound", "unit", "scale_low", "scale_high", "logit", "logit_bound"),
    (*_INPUTS, *(f"{kind}_{name}" for kind in ("out", "g") for name in _OUTPUTS), "d_raw"),
)  # struct ComposeJob of splat/kernels/compose.h


def compiled(raw: Tensor, *fixed: Tensor) -> bool:
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
    """Means, covariances and opacities, as `gsgan.model.deformation.Deformation.compose` defines
    them; differentiable once, in ``raw``.

    Args:
        raw: ``[B, N, 11]`` residuals of mean, quaternion, scale and opacity.
        means, frames, scales, valid: of `gsgan.skeleton.Points`, without gradient.
        numbers: bound of the means in metres (0: none), metres of a residual of 1 without a bound,
            least and largest logarithm of a scale, the opacity's logit and its bound.

    Returns:
        ``[B, N, 3]``, ``[B, N, 3, 3]``, ``[B, N]``.
    """
    return _Geometry.apply(raw, means, frames, scales, valid, numbers)  # type: ignore[no-any-return]


class _Geometry(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        raw, *fixed, numbers = arguments
        B, N, _ = raw.shape
        means, covariances = raw.new_empty(B, N, 3), raw.new_empty(B, N, 3, 3)
        opacities = raw.new_empty(B, N)
        job, _held = _job(raw, fixed, numbers)
        outputs = [means, covariances, opacities]
        build.point(job, tuple(f"out_{name}" for name in _OUTPUTS), outputs)
        build.function("compose", raw.dtype)(ctypes.byref(job))
        ctx.save_for_backward(raw, *fixed)
        ctx.numbers = numbers
        ctx.set_materialize_grads(False)
        return means, covariances, opacities

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        raw, *fixed = ctx.saved_tensors
        job, _held = _job(raw, fixed, ctx.numbers)
        incoming = [None if g is None else g.contiguous() for g in grads]
        build.point(job, tuple(f"g_{name}" for name in _OUTPUTS), incoming)
        d_raw = raw.new_empty(*raw.shape[:2], RESIDUALS)
        build.point(job, ("d_raw",), [d_raw])
        build.function("compose_backward", raw.dtype)(ctypes.byref(job))
        return d_raw, *[None] * 5


def _job(raw: Tensor, fixed: list[Tensor], numbers: tuple[float, ...]) -> tuple[Any, list[Tensor]]:
    """The job without its outputs, and the tensors it points to."""
    rows = raw.detach()
    if rows.stride(-1) != 1 or rows.stride(0) != rows.shape[1] * rows.stride(1):
        rows = rows.contiguous()
    held = [rows, *(x.detach().contiguous() for x in fixed)]
    threads = build.threads()
    job = _Job(rows.shape[0] * rows.shape[1], threads, rows.stride(1), *numbers)
    build.point(job, _INPUTS, held)
    return job, held
