"""The compiled compositing kernel for CPUs: native.cpp, built on first use, called through ctypes.

When it cannot be built, ``available()`` is False and ``why_not()`` has the reason.
"""

import ctypes
from typing import Any

import torch
from torch import Tensor

from gsgan.splat import build
from gsgan.splat.buffers import zeros
from gsgan.splat.project import Projected
from gsgan.splat.settings import Accuracy

# Memory of the backward pass for gradients per (tile, Gaussian) before they are summed.
SLOT_BYTES = 1 << 28

_OUT_OF_MEMORY = 1
_NOT_FINITE = 2

# Fields of a job that are addresses of tensors.
_ELLIPSES = (
    "means",
    "factors",
    "opacities",
    "features",
    "depths",
    "extents",
    "visible",
)
_IMAGES = ("out_features", "out_alpha", "out_average")
_IMAGE_GRADS = ("g_features", "g_alpha", "g_average")
_ELLIPSE_GRADS = ("d_means", "d_factors", "d_opacities", "d_features")
IMAGE_CHANNELS = 3  # of colours; features of more channels are for networks
AVERAGES = (
    1,
    2,
    4,
    8,
)  # supersampling that is averaged here: divisors of a tile

# struct Job of kernels/job.h
_Job = build.job_type(
    integers=(
        "B",  # batch items
        "N",  # Gaussians per item
        "C",  # channels
        "H",
        "W",
        "threads",
        "keep",  # whether tile lists are kept for the backward pass
        "box",  # whether extents cut off pixels
        "slot_bytes",
        "times",
        "rows",  # whether features are channels last
    ),
    numbers=("alpha_min", "transmittance_min", "alpha_max"),
    addresses=(*_ELLIPSES, *_IMAGES, *_IMAGE_GRADS, *_ELLIPSE_GRADS),
    results=("bad",),
)


def available() -> bool:
    """Whether the kernel can be used; the first call may compile it (seconds).

    It is not available to programs that ``torch.export`` records.
    """
    return not torch.compiler.is_compiling() and build.library()[0] is not None


def why_not() -> str:
    """Why the kernel is not available, in one sentence; empty when it is available."""
    return build.library()[1]


def composite(
    projected: Projected,
    size: tuple[int, int],
    settings: Accuracy,
    times: int = 1,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Blends ellipses front to back on the CPU.

    Pixel centres are at +0.5; ``alpha = min(alpha_max, o exp(-q / 2))`` inside the extent,
    skipped below ``alpha_min`` or if the incoming transmittance is below
    ``transmittance_min``; ordered by depth, ties by index. If alpha is capped, opacity and shape
    get no gradient. The result is bit-identical for any number of threads
    (``torch.get_num_threads()``).

    Args:
        projected: the ellipses on the CPU; the features' dtype, float32 or float64, is that of the
            arithmetic.
        size: (H, W) pixels.
        settings: alpha_min, transmittance_min, alpha_max, and whether the extent is ``sigma``:
            only then ``projected.extents`` cut off pixels.
        times: one of ``AVERAGES``: above 1 features and alpha are also averaged over so many pixels
            each way.

    Returns:
        features ``[B, C, H, W]`` premultiplied, channels last if they are averaged or more than
        colours; alpha
        ``[B, 1, H / times, W / times]``, and averaged features ``[B, C, H / times, W / times]`` or
        None. Differentiable once in means, factors, opacities and features.

    Raises:
        ValueError: on a visible Gaussian that is not finite.

    Source: paper Sec. 3.1; tiles after 3D Gaussian splatting, gradients derived in native.cpp.
    """
    # autograd has no types for what a function returns.
    composed: tuple[Tensor, Tensor, Tensor | None] = _Composite.apply(
        projected.means,
        projected.factors,
        projected.opacities,
        projected.features,
        projected.depths,
        projected.extents,
        projected.visible,
        size,
        settings,
        times,
        torch.is_grad_enabled(),
    )
    return composed


class _Plan:
    """Tile lists of the forward pass, for the backward pass; owns memory of the library."""

    def __init__(self, dtype: torch.dtype) -> None:
        # The function is kept, since modules may be gone when Python ends.
        self.pointer = ctypes.c_void_p()
        self._free = build.function("free", dtype)

    def __del__(self) -> None:
        if self.pointer:
            self._free(self.pointer)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        factors: Tensor,
        opacities: Tensor,
        features: Tensor,
        depths: Tensor,
        extents: Tensor,
        visible: Tensor,
        size: tuple[int, int],
        settings: Accuracy,
        times: int,
        grad_enabled: bool,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        # The kernel reads contiguous arrays.
        tensors = [
            means,
            factors,
            opacities,
            features,
            depths,
            extents,
            visible,
        ]
        inputs = [x.detach().contiguous() for x in tensors]
        B, _, C = features.shape
        dtype = features.dtype
        coarse = (size[0] // times, size[1] // times)

        # The kernel writes into the outputs and keeps its tile lists for the backward pass.
        job = _job(size, settings, inputs, times)
        alpha = zeros((B, 1, *coarse), dtype)
        average = None if times == 1 else zeros((B, C, *coarse), dtype)
        if job.rows:
            drawn = zeros((B, *size, C), dtype).permute(0, 3, 1, 2)
        else:
            drawn = zeros((B, C, *size), dtype)
        job.keep = grad_enabled and any(ctx.needs_input_grad)
        build.point(job, _IMAGES, [drawn, alpha, average])
        plan = _Plan(dtype)
        run = build.function("forward", dtype)
        _raise_for(run(ctypes.byref(job), ctypes.byref(plan.pointer)), job)

        # The plan lives as long as the graph.
        if job.keep:
            ctx.save_for_backward(*tensors)
            ctx.plan = plan
            ctx.size = size
            ctx.settings = settings
            ctx.times = times
            ctx.set_materialize_grads(False)
        return drawn, alpha, average

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        # The same job as in the forward pass.
        inputs = [x.detach().contiguous() for x in ctx.saved_tensors]
        job = _job(ctx.size, ctx.settings, inputs, ctx.times)

        # Gradients of the outputs, in the memory format of the outputs.
        incoming = [None if g is None else g.contiguous() for g in grads]
        if job.rows and grads[0] is not None:
            incoming[0] = grads[0].contiguous(memory_format=torch.channels_last)
        build.point(job, _IMAGE_GRADS, incoming)

        # The kernel adds the gradients of means, factors, opacities and features.
        outgoing = [torch.zeros_like(x) for x in inputs[: len(_ELLIPSE_GRADS)]]
        build.point(job, _ELLIPSE_GRADS, outgoing)
        run = build.function("backward", inputs[3].dtype)
        _raise_for(run(ctypes.byref(job), ctx.plan.pointer), job)

        # Other arguments have no gradient, and some tensors need none.
        needed = ctx.needs_input_grad
        returned: list[Tensor | None] = [None] * len(needed)
        for i, gradient in enumerate(outgoing):
            if needed[i]:
                returned[i] = gradient
        return tuple(returned)


def _job(
    size: tuple[int, int],
    settings: Accuracy,
    inputs: list[Tensor],
    times: int,
) -> Any:
    """A job with its inputs, without outputs and gradients."""
    B, N, C = inputs[3].shape
    job = _Job(
        B=B,
        N=N,
        C=C,
        H=size[0],
        W=size[1],
        threads=build.threads(),
        box=settings.extent == "sigma",
        slot_bytes=SLOT_BYTES,
        times=times,
        # Networks read channels last; each pixel's channels are averaged together.
        rows=times > 1 or C > IMAGE_CHANNELS,
        alpha_min=settings.alpha_min,
        transmittance_min=settings.transmittance_min,
        alpha_max=settings.alpha_max,
    )
    build.point(job, _ELLIPSES, inputs)
    return job


def _raise_for(status: int, job: Any) -> None:
    # The kernel returns 0, or the kind of its error.
    if status == 0:
        return
    if status == _NOT_FINITE:
        b, n = divmod(job.bad, job.N)
        raise ValueError(
            "composite: visible Gaussians must be finite, got NaN or infinity in the mean, "
            f"factors, opacity, depth or extent of Gaussian {n} of batch item {b}"
        )
    if status == _OUT_OF_MEMORY:
        raise MemoryError(
            "composite: out of memory; use a smaller image, batch or extent"
        )
    raise ValueError(
        f"composite: {job.B} images of {job.H} x {job.W} with {job.N} Gaussians give more than "
        "2^32 pairs of tile and Gaussian; use a smaller image, batch or extent"
    )
