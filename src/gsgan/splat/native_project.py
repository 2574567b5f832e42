"""The compiled projection for CPUs: ``project`` in one pass over the Gaussians.

The many small operations of :func:`gsgan.splat.project.project` take as long as the compositing
kernel. They remain the portable path, and the reference in tests.
"""

import ctypes
import math
from typing import Any

import torch
from torch import Tensor

from gsgan.scene import Camera, Gaussians
from gsgan.splat import build
from gsgan.splat.project import (
    EXP_UNDERFLOW,
    EXTENT_MARGIN,
    QUAT_MIN,
    Projected,
    field_of_view,
)
from gsgan.splat.settings import Accuracy

_INPUTS = ("means", "quats", "scales", "covariances", "opacities")
_CAMERA = ("K", "R", "t", "limits")
_OUTPUTS = ("means", "factors", "opacities", "depths")

_Job = build.job_type(
    ("B", "N", "H", "W", "threads", "antialias"),
    ("near", "low_pass", "alpha_min", "reach", "extent_margin", "quat_min"),
    (
        *(
            *_INPUTS,
            *_CAMERA,
            *(f"out_{name}" for name in (*_OUTPUTS, "extents")),
            "visible",
        ),
        *(f"g_{name}" for name in _OUTPUTS),
        *(f"d_{name}" for name in (*_INPUTS, *_CAMERA)),
    ),
)  # struct ProjectJob of kernels/ewa.h


def project(gaussians: Gaussians, camera: Camera, settings: Accuracy) -> Projected:
    """``gsgan.splat.project.project`` on the CPU, with the same arguments.

    Convention: differentiable once. The result is bit-identical for any number of threads.

    Source: gradients derived in kernels/ewa.h.
    """
    dtype = torch.promote_types(gaussians.means.dtype, settings.torch_dtype)
    K = camera.K.to(torch.float64)
    R = camera.R.to(torch.float64)
    t = camera.t.to(torch.float64)
    limits = torch.cat(
        field_of_view(K, camera.size, settings.fov_clamp), dim=1
    ).squeeze(-1)
    quats = scales = covariances = None
    if gaussians.covariances is not None:
        covariances = gaussians.covariances.to(dtype)
    else:
        assert gaussians.quats is not None
        assert gaussians.scales is not None
        quats = gaussians.quats.to(dtype)
        scales = gaussians.scales.to(dtype)
    means, factors, opacities, depths, extents, visible = _Project.apply(
        gaussians.means.to(dtype),
        quats,
        scales,
        covariances,
        gaussians.opacities.to(dtype),
        K,
        R,
        t,
        limits,
        camera.size,
        settings,
    )
    features = gaussians.features.to(dtype)
    return Projected(means, factors, opacities, features, depths, extents, visible)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        *tensors, size, settings = arguments
        job, held = _job(tensors, size, settings)
        means = held[0]
        opacities = held[4]
        assert means is not None
        assert opacities is not None
        B, N = opacities.shape

        # Geometry is in float64, opacities and extents in the features' precision.
        outputs = [
            means.new_empty(B, N, 2, dtype=torch.float64),  # means
            means.new_empty(B, N, 3, dtype=torch.float64),  # factors
            means.new_empty(B, N),  # opacities
            means.new_empty(B, N, dtype=torch.float64),  # depths
            means.new_empty(B, N, 2),  # extents
        ]
        visible = torch.empty(B, N, dtype=torch.bool)
        build.point(
            job, tuple(f"out_{name}" for name in (*_OUTPUTS, "extents")), outputs
        )
        build.point(job, ("visible",), [visible])
        build.function("project", means.dtype)(ctypes.byref(job))
        ctx.save_for_backward(*tensors)
        ctx.size = size
        ctx.settings = settings
        ctx.mark_non_differentiable(outputs[-1], visible)
        ctx.set_materialize_grads(False)
        return (*outputs, visible)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        job, held = _job(ctx.saved_tensors, ctx.size, ctx.settings)
        incoming = [
            None if g is None else g.contiguous() for g in grads[: len(_OUTPUTS)]
        ]
        build.point(job, tuple(f"g_{name}" for name in _OUTPUTS), incoming)
        needed = ctx.needs_input_grad
        # The camera's gradients are few numbers: always computed, returned where needed.
        outgoing = [
            None
            if x is None or not (need or i >= len(_INPUTS))
            else torch.zeros_like(x)
            for i, (x, need) in enumerate(zip(held, needed, strict=False))
        ]
        build.point(job, tuple(f"d_{name}" for name in (*_INPUTS, *_CAMERA)), outgoing)
        assert held[0] is not None
        if build.function("project_backward", held[0].dtype)(ctypes.byref(job)):
            raise MemoryError("project: out of memory")
        grads_in = [
            g if need else None for g, need in zip(outgoing, needed, strict=False)
        ]
        return (*grads_in, *[None] * (len(needed) - len(grads_in)))


def _job(
    tensors: Any, size: tuple[int, int], settings: Accuracy
) -> tuple[Any, list[Tensor | None]]:
    """The job without its outputs, and the tensors it points to."""
    held = [None if x is None else x.detach().contiguous() for x in tensors]
    opacities = held[len(_INPUTS) - 1]
    assert opacities is not None
    reach, margin = _reach(settings)
    job = _Job(
        *(*opacities.shape, *size, build.threads(), settings.antialias),
        *(
            settings.near,
            settings.low_pass,
            settings.alpha_min,
            reach,
            margin,
            QUAT_MIN,
        ),
    )
    build.point(job, (*_INPUTS, *_CAMERA), held)
    return job, held


def _reach(settings: Accuracy) -> tuple[float, float]:
    """Half-size of the footprint in standard deviations (-1: by opacity), and its margin."""
    if settings.extent == "sigma":
        return settings.radius_sigmas, 0.0
    if settings.extent == "opacity" and settings.alpha_min > 0:
        return -1.0, EXTENT_MARGIN
    return math.sqrt(2 * EXP_UNDERFLOW), EXTENT_MARGIN
