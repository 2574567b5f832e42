"""The geometry of Ĝ from Ψ's raw residuals in compiled code, on CPUs.

`gsgan.model.deformation.Deformation` calls it, and defines the same by tensor operations.
"""

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gsgan.splat import build, native

RESIDUALS = 11  # mean 3, quaternion 4, scale 3, opacity 1
OUTPUTS = ("means", "covariances", "opacities")
INPUTS = ("raw", "means", "frames", "shapes", "scales", "valid")
_Job = build.job_type(
    ("count", "threads", "stride"),
    ("mean_bound", "unit", "scale_low", "scale_high", "logit", "logit_bound"),
    (
        *INPUTS,
        *(f"out_{name}" for name in OUTPUTS),
        *(f"g_{name}" for name in OUTPUTS),
        "d_raw",
    ),
)


def has_geometry(raw: Tensor, means: Tensor, *fixed: Tensor) -> bool:
    """Whether `geometry` can be used: on a CPU, where only raw and means need a gradient."""
    return (
        raw.device.type == "cpu"
        and raw.dtype in build.DTYPES
        and means.dtype == raw.dtype
        and not any(
            x.requires_grad or x.dtype not in (raw.dtype, torch.bool)
            for x in fixed
        )
        and native.available()
    )


def geometry(
    raw: Tensor,
    means: Tensor,
    frames: Tensor,
    shapes: Tensor,
    scales: Tensor,
    valid: Tensor,
    numbers: tuple[float, ...],
) -> tuple[Tensor, Tensor, Tensor]:
    """Means, covariances and opacities of Ĝ; differentiable once, in ``raw`` and ``means``.

    Args:
        raw: ``[B, N, 11]`` residuals of mean, quaternion, scale and opacity.
        means, frames, shapes, scales, valid: of `gsgan.skeleton.Points`; the last four without a
            gradient.
        numbers: bound of the means in metres (0: none), metres of a residual of 1 without a bound,
            least and largest logarithm of a scale, the opacity's logit and its bound.

    Returns:
        ``[B, N, 3]``, ``[B, N, 3, 3]``, ``[B, N]``.
    """
    return _Geometry.apply(raw, means, frames, shapes, scales, valid, numbers)  # type: ignore[no-any-return]


class _Geometry(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        raw, *fixed, numbers = arguments

        # The job points to the inputs and to empty outputs, which the compiled code fills.
        B, N, _ = raw.shape
        outputs = (
            raw.new_empty(B, N, 3),
            raw.new_empty(B, N, 3, 3),
            raw.new_empty(B, N),
        )
        job, _held = _job(raw, fixed, numbers)
        build.point(job, [f"out_{name}" for name in OUTPUTS], outputs)
        build.function("compose", raw.dtype)(ctypes.byref(job))

        # The backward pass starts from the inputs; gradients of unused outputs stay None.
        ctx.save_for_backward(raw, *fixed)
        ctx.numbers = numbers
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        raw, *fixed = ctx.saved_tensors

        # The job is the forward one, with incoming gradients and the gradient of raw as its
        # output.
        job, _held = _job(raw, fixed, ctx.numbers)
        incoming = [None if g is None else g.contiguous() for g in grads]
        d_raw = raw.new_empty(*raw.shape[:2], RESIDUALS)
        build.point(
            job,
            [*(f"g_{name}" for name in OUTPUTS), "d_raw"],
            [*incoming, d_raw],
        )
        build.function("compose_backward", raw.dtype)(ctypes.byref(job))
        # an output's mean is the given one and an offset
        return d_raw, grads[0], *[None] * 5


def _job(
    raw: Tensor, fixed: list[Tensor], numbers: tuple[float, ...]
) -> tuple[ctypes.Structure, list[Tensor]]:
    """The job without its outputs, and the tensors it points to."""
    # The compiled code reads rows with a constant stride, so raw may be a part of wider rows.
    rows = raw.detach()
    if rows.stride(-1) != 1 or rows.stride(0) != rows.shape[1] * rows.stride(1):
        rows = rows.contiguous()

    # The tensors must live as long as the job, which holds addresses only.
    held = [rows, *(x.detach().contiguous() for x in fixed)]
    job = _Job(
        rows.shape[0] * rows.shape[1], build.threads(), rows.stride(1), *numbers
    )
    build.point(job, INPUTS, held)
    return job, held
