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

# Fields of a job that are addresses of tensors.
_GAUSSIANS = ("means", "quats", "scales", "covariances", "opacities")
_CAMERA = ("K", "R", "t", "limits")
_PROJECTED = (
    "out_means",
    "out_factors",
    "out_opacities",
    "out_depths",
    "out_extents",
    "visible",
)
_PROJECTED_GRADS = ("g_means", "g_factors", "g_opacities", "g_depths")
_GRADS = tuple(f"d_{name}" for name in (*_GAUSSIANS, *_CAMERA))

# struct ProjectJob of kernels/ewa.h
_Job = build.job_type(
    integers=("B", "N", "H", "W", "threads", "antialias"),
    numbers=(
        "near",
        "low_pass",
        "alpha_min",
        "reach",
        "extent_margin",
        "quat_min",
    ),
    addresses=(*_GAUSSIANS, *_CAMERA, *_PROJECTED, *_PROJECTED_GRADS, *_GRADS),
)


def project(
    gaussians: Gaussians, camera: Camera, settings: Accuracy
) -> Projected:
    """``gsgan.splat.project.project`` on the CPU, with the same arguments.

    It is differentiable once. The result is bit-identical for any number of threads.

    Source: gradients derived in kernels/ewa.h.
    """
    # Cameras are in float64, Gaussians in the precision of the settings or a higher one.
    dtype = torch.promote_types(gaussians.means.dtype, settings.torch_dtype)

    # Camera and bounds are few numbers: float64 costs nothing.
    K = camera.K.to(torch.float64)
    R = camera.R.to(torch.float64)
    t = camera.t.to(torch.float64)
    limits = torch.cat(field_of_view(K, camera.size, settings.fov_clamp), dim=1)

    # Shapes are covariances, or else rotations and scales.
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
        limits.squeeze(-1),
        camera.size,
        settings,
    )
    features = gaussians.features.to(dtype)
    return Projected(
        means=means,
        factors=factors,
        opacities=opacities,
        features=features,
        depths=depths,
        extents=extents,
        visible=visible,
    )


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, ...]:
        # Tensors that are not given are None, and stay so in the job.
        *tensors, size, settings = arguments
        job, held = _job(tensors, size, settings)
        means = held[0]
        assert means is not None

        # Geometry is in float64, opacities and extents in the features' precision.
        outputs = (
            means.new_empty(job.B, job.N, 2, dtype=torch.float64),  # means
            means.new_empty(job.B, job.N, 3, dtype=torch.float64),  # factors
            means.new_empty(job.B, job.N),  # opacities
            means.new_empty(job.B, job.N, dtype=torch.float64),  # depths
            means.new_empty(job.B, job.N, 2),  # extents
            means.new_empty(job.B, job.N, dtype=torch.bool),  # visible
        )
        build.point(job, _PROJECTED, outputs)
        build.function("project", means.dtype)(ctypes.byref(job))

        # Extents and visibility are cut-offs, without gradients.
        ctx.save_for_backward(*tensors)
        ctx.size = size
        ctx.settings = settings
        ctx.mark_non_differentiable(*outputs[-2:])
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        # Gradients of extents and visibility do not exist.
        job, held = _job(ctx.saved_tensors, ctx.size, ctx.settings)
        incoming = [None if g is None else g.contiguous() for g in grads]
        build.point(job, _PROJECTED_GRADS, incoming)

        # The camera's gradients are few numbers: always computed, returned if needed.
        needed = ctx.needs_input_grad
        outgoing: list[Tensor | None] = [None] * len(needed)
        for i, tensor in enumerate(held):
            if tensor is not None and (needed[i] or i >= len(_GAUSSIANS)):
                outgoing[i] = torch.zeros_like(tensor)
        build.point(job, _GRADS, outgoing)
        assert held[0] is not None
        if build.function("project_backward", held[0].dtype)(ctypes.byref(job)):
            raise MemoryError("project: out of memory")
        return tuple(
            g if need else None
            for g, need in zip(outgoing, needed, strict=True)
        )


def _job(
    tensors: Any,
    size: tuple[int, int],
    settings: Accuracy,
) -> tuple[Any, list[Tensor | None]]:
    """The job without its outputs, and the tensors it points to."""
    # The caller keeps these tensors alive until the kernel has run.
    held = [None if x is None else x.detach().contiguous() for x in tensors]
    means = held[0]
    assert means is not None
    reach, margin = _reach(settings)
    job = _Job(
        B=means.shape[0],
        N=means.shape[1],
        H=size[0],
        W=size[1],
        threads=build.threads(),
        antialias=settings.antialias,
        near=settings.near,
        low_pass=settings.low_pass,
        alpha_min=settings.alpha_min,
        reach=reach,
        extent_margin=margin,
        quat_min=QUAT_MIN,
    )
    build.point(job, (*_GAUSSIANS, *_CAMERA), held)
    return job, held


def _reach(settings: Accuracy) -> tuple[float, float]:
    """Half-size of the footprint in standard deviations (-1: by opacity), and its margin."""
    # As in `gsgan.splat.project._footprint`.
    if settings.extent == "sigma":
        return settings.radius_sigmas, 0.0
    if settings.extent == "opacity" and settings.alpha_min > 0:
        return -1.0, EXTENT_MARGIN
    return math.sqrt(2 * EXP_UNDERFLOW), EXTENT_MARGIN
