"""Normalisation, style and activation of the generator's pixels, compiled for CPUs."""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from gsgan.splat import build, native


class _Job(ctypes.Structure):
    """Mirrors ``struct StyleJob`` of splat/kernels/style.h field by field."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("rows", "C", "threads")),
        *((name, ctypes.c_double) for name in ("floor", "slope")),
        *((name, ctypes.c_void_p) for name in ("h", "modulation", "out")),
        *((name, ctypes.c_void_p) for name in ("g", "d_h", "d_modulation")),
    )


def compiled(rows: Tensor, modulation: Tensor) -> bool:
    """Whether `styled` can be used: on a CPU, with a modulation for every pixel."""
    return (
        rows.device.type == "cpu"
        and rows.dtype == modulation.dtype
        and rows.dtype in build.DTYPES
        and rows.shape[:-1] == modulation.shape[:-1]
        and native.available()
    )


def styled(rows: Tensor, modulation: Tensor, floor: float, slope: float) -> Tensor:
    """``leaky_relu(unit * (1 + scale) + shift)``, unit the normalised channels of each pixel.

    Convention: differentiable once; the same result with any number of threads.

    Args:
        rows: ``[B, H, W, C]``.
        modulation: ``[B, H, W, 2 C]`` scales, then shifts.
        floor: added to the mean square.
        slope: of the activation below 0.
    """
    return _Styled.apply(rows, modulation, floor, slope)  # type: ignore[no-any-return]


class _Styled(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, h: Tensor, modulation: Tensor, floor: float, slope: float) -> Tensor:
        h, modulation = h.contiguous(), modulation.contiguous()
        out = torch.empty_like(h)
        build.point(job := _job(h, floor, slope), ("h", "modulation", "out"), [h, modulation, out])
        build.function("style", h.dtype)(ctypes.byref(job))
        ctx.save_for_backward(h, modulation, out)
        ctx.numbers = floor, slope
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        h, modulation, out = ctx.saved_tensors
        grads = [torch.empty_like(h), torch.empty_like(modulation)]
        held = [h, modulation, out, grad.contiguous(), *grads]
        job = _job(h, *ctx.numbers)
        build.point(job, ("h", "modulation", "out", "g", "d_h", "d_modulation"), held)
        build.function("style_backward", h.dtype)(ctypes.byref(job))
        return *grads, None, None


def _job(h: Tensor, floor: float, slope: float) -> _Job:
    rows, channels = h.shape[:-1].numel(), h.shape[-1]
    return _Job(rows, channels, build.threads(), floor, slope)
