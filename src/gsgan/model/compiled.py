"""Points on a skinned body, and the geometry of Ĝ, in compiled code, on CPUs.

`gsgan.model.body_points.BodyPoints` calls `skin_points`, `gsgan.model.deformation.Deformation`
calls `geometry`; both define the same by tensor operations.
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

SKINNED = ("means", "frames", "origins", "shapes", "normals")
SKIN_INPUTS = (
    "bones",
    "rest",
    "normals",
    "index",
    "weight",
    "steep",
    "slopes",
)
# struct SkinJob of kernels/skin.h
_SkinJob = build.job_type(
    ("poses", "count", "threads", "joints", "followed", "kept"),
    ("floor", "limit"),
    (*SKIN_INPUTS, *(f"out_{name}" for name in SKINNED), "g_means", "d_weight"),
)


def has_skinned(bones: Tensor, weight: Tensor) -> bool:
    """Whether `skin_points` can be used: on a CPU, where no bone's transform needs a gradient."""
    return (
        bones.device.type == "cpu"
        and bones.dtype in build.DTYPES
        and weight.dtype == bones.dtype
        and not bones.requires_grad
        and native.available()
    )


def skin_points(
    bones: Tensor,
    rest: Tensor,
    normals: Tensor,
    weights: tuple[Tensor, Tensor],
    slopes: tuple[Tensor, Tensor] | None,
    floor: float,
    limit: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor]:
    """Points on a skinned body in B poses; means are differentiable once, in the weights.

    Args:
        bones: ``[B, J, 4, 4]``.
        rest, normals: ``[N, 3]`` at rest.
        weights: ``[N, n]`` bones of each point and their weights, which are divided by their sum.
        slopes: of `gsgan.body.skinned.WeightGradients`; None: shapes follow the frames alone.
        floor: share of the area at rest at which a normal fades.
        limit: of `gsgan.body.lbs.stretch_jacobian`.

    Returns:
        Means ``[B, N, 3]``, frames and origins (A and t of LBS), the Jacobians ``[B, N, 3, 3]``
        (None without slopes) and normals ``[B, N, 3]``.
    """
    index, weight = weights
    steep, slope = (None, None) if slopes is None else slopes
    inputs = (bones, rest, normals, index, weight, steep, slope)
    means, frames, origins, shapes, turned = _Skin.apply(
        (floor, limit), *inputs
    )
    return means, frames, origins, None if slopes is None else shapes, turned


class _Skin(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, bounds: tuple[float, float], *inputs: Tensor | None
    ) -> tuple[Tensor, ...]:
        bones, rest = inputs[:2]
        assert bones is not None
        assert rest is not None

        # The job points to the inputs and to empty outputs, which the compiled code fills.
        size = (len(bones), len(rest))
        means, origins, normals = (bones.new_empty(*size, 3) for _ in range(3))
        frames, shapes = (bones.new_empty(*size, 3, 3) for _ in range(2))
        outputs = (means, frames, origins, shapes, normals)
        job, _held = _skin_job(bounds, inputs)
        build.point(job, [f"out_{name}" for name in SKINNED], outputs)
        build.function("skin", bones.dtype)(ctypes.byref(job))

        # Only the means have a gradient.
        ctx.bounds = bounds
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(frames, origins, shapes, normals)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_means: Tensor, *_: Any) -> tuple[Any, ...]:  # type: ignore[override]
        inputs = ctx.saved_tensors
        weight = inputs[SKIN_INPUTS.index("weight")]
        job, _held = _skin_job(ctx.bounds, inputs)
        incoming = g_means.contiguous()
        d_weight = torch.empty_like(
            weight, memory_format=torch.contiguous_format
        )
        build.point(job, ("g_means", "d_weight"), (incoming, d_weight))
        build.function("skin_backward", weight.dtype)(ctypes.byref(job))
        gradients: list[Any] = [None] * (1 + len(inputs))
        gradients[1 + SKIN_INPUTS.index("weight")] = d_weight
        return tuple(gradients)


def _skin_job(
    bounds: tuple[float, float], inputs: tuple[Tensor | None, ...]
) -> tuple[ctypes.Structure, list[Tensor | None]]:
    """The job without its outputs, and the tensors it points to."""
    # The tensors must live as long as the job, which holds addresses only.
    held = [None if x is None else x.detach().contiguous() for x in inputs]
    bones, rest, _, index, _, steep, _ = held
    assert bones is not None
    assert rest is not None
    assert index is not None
    job = _SkinJob(
        len(bones),
        len(rest),
        build.threads(),
        bones.shape[1],
        index.shape[1],
        0 if steep is None else steep.shape[1],
        *bounds,
    )
    build.point(job, SKIN_INPUTS, held)
    return job, held


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
