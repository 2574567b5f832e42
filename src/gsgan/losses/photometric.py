"""L1 and D-SSIM, as Step I uses them (paper Eq. for L_Ψ)."""

import ctypes
from typing import Any

import torch
from kornia.filters import filter2d_separable, get_gaussian_kernel1d
from torch import Tensor

from gsgan.splat import build, native
from gsgan.utils.tensors import full_precision

# Pixels, of the Gaussian window; shorter sides cannot be reflected.
HALF_WINDOW = 5
# Pixels.
WINDOW_SIGMA = 1.5


def d_ssim(image: Tensor, target: Tensor) -> Tensor:
    """1 - SSIM, mean over pixels, of images ``[B, C, H, W]`` in [0, 1]; borders are reflected.

    Source: 3DGS and this paper weight 1 - SSIM, not half of it.
    """
    return d_ssim_map(image, target).mean()


def d_ssim_map(
    image: Tensor,
    target: Tensor,
    *,
    k: tuple[float, float] = (0.01, 0.03),
) -> Tensor:
    """1 - SSIM at every pixel, accurate in float32 for flat and nearly equal images too.

    Computed in float32 at least, autocast has no effect; borders are reflected. SSIM is luminance
    times structure, both of which follow from the difference of the images:

        L = 1 - luminance = (μx - μy)² / (μx² + μy² + C1)
        S = 1 - structure = var(x - y) / (var x + var y + C2)
        1 - SSIM = L + S - L S

    with means and variances over a Gaussian window. The usual form is equal in exact arithmetic,
    but its covariance cancels where images are equal or flat, which leaves float32 gradients wrong
    by tens of per cent.

    Args:
        image, target: ``[B, C, H, W]`` in [0, 1], both sides longer than `HALF_WINDOW`.
        k: the stabilising constants, relative to the range.

    Returns:
        ``[B, C, H, W]`` in [0, 2].

    Source: Wang et al. 2004.
    """
    with full_precision(image.device):
        wide = torch.promote_types(image.dtype, torch.float32)
        image = image.to(wide)
        target = target.to(wide)

        # Both images and their difference d = x - y about their means: squares stay small.
        difference = image - target
        middle = image.detach().mean((-2, -1), keepdim=True)
        shift = difference.detach().mean((-2, -1), keepdim=True)
        x = image - middle
        y = target - (middle - shift)
        d = difference - shift

        # Local means of x, d, x² + y² and d² in one convolution.
        squares = x.square() + y.square()
        moments = torch.cat([x, d, squares, d.square()], dim=1)
        window = 2 * HALF_WINDOW + 1
        kernel = get_gaussian_kernel1d(
            window,
            WINDOW_SIGMA,
            device=x.device,
            dtype=wide,
        )
        local = filter2d_separable(moments, kernel, kernel)
        mean_x, mean_d, power, power_d = local.chunk(4, dim=1)

        # 1 - structure, with var x + var y and var d as mean square less squared mean.
        c1 = k[0] ** 2
        c2 = k[1] ** 2
        variances = power - mean_x.square() - (mean_x - mean_d).square()
        structure = (power_d - mean_d.square()) / (variances + c2)

        # 1 - luminance, with the means shifted back.
        mean_x = mean_x + middle
        mean_d = mean_d + shift
        mean_y = mean_x - mean_d
        luminance = mean_d.square() / (mean_x.square() + mean_y.square() + c1)
        return luminance + structure - luminance * structure


def photometric(
    image: Tensor,
    target: Tensor,
    *,
    l1: float = 0.8,
    l2: float = 0.0,
    ssim: float = 0.2,
    ignored: Tensor | None = None,
) -> Tensor:
    """Weighted L1, squared error and D-SSIM; a term of weight 0 is not computed.

    Args:
        image, target: ``[B, 3, H, W]``.
        l1, l2, ssim: weights.
        ignored: see `without_ignored`.
    """
    target = without_ignored(target, image, ignored)

    # On a CPU, all terms in one pass.
    if _can_compile(image, target):
        return _Photometric.apply(image, target, l1, l2, ssim)  # type: ignore[no-any-return]

    # The sum of the terms, without those that have no weight.
    difference = image - target
    loss = difference.new_zeros(())
    if l1:
        loss = loss + l1 * difference.abs().mean()
    if l2:
        loss = loss + l2 * difference.square().mean()
    if ssim:
        loss = loss + ssim * d_ssim(image, target)
    return loss


def _can_compile(image: Tensor, target: Tensor) -> bool:
    """Whether the compiled loss is used: on a CPU, for float32 and float64 images."""
    return (
        image.device.type == "cpu"
        and image.dtype == target.dtype
        and image.dtype in build.DTYPES
        and image.shape == target.shape
        and min(image.shape[-2:]) > HALF_WINDOW
        and not target.requires_grad
        and native.available()
    )


# struct PhotometricJob of splat/kernels/photometric.h
_TENSORS = ("image", "target", "d_image", "totals")
_Job = build.job_type(
    integers=("planes", "H", "W", "threads"),
    numbers=("l1", "l2", "ssim"),
    addresses=_TENSORS,
)


class _Photometric(torch.autograd.Function):
    """`photometric` in one pass, fifteen times as fast as its many small operations. The result is
    bit-identical for any number of threads."""

    @staticmethod
    def forward(
        ctx: Any,
        image: Tensor,
        target: Tensor,
        l1: float,
        l2: float,
        ssim: float,
    ) -> Tensor:
        # The kernel reads planes of pixels; it writes each plane's loss and the gradient.
        image = image.detach().contiguous()
        target = target.detach().contiguous()
        gradient = torch.empty_like(image) if ctx.needs_input_grad[0] else None
        planes = image.shape[:-2].numel()
        totals = torch.empty(planes, dtype=torch.float64)

        height, width = image.shape[-2:]
        job = _Job(planes, height, width, build.threads(), l1, l2, ssim)
        build.point(job, _TENSORS, [image, target, gradient, totals])
        if build.function("photometric", image.dtype)(ctypes.byref(job)):
            raise MemoryError("photometric: out of memory")

        # Totals are sums over pixels.
        ctx.gradient = gradient
        return (totals.sum() / image.numel()).to(image.dtype)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        # The gradient was computed with the loss.
        return ctx.gradient * grad, None, None, None, None


def without_ignored(
    target: Tensor, image: Tensor, ignored: Tensor | None
) -> Tensor:
    """The target, with the image itself at pixels that must not contribute to a loss.

    A per-pixel loss and its gradient are exactly 0 there; losses over windows (SSIM, networks)
    still see the neighbours.

    Args:
        target, image: ``[B, 3, H, W]``.
        ignored: ``[B, 1, H, W]``, above 0 at those pixels; None for none.
    """
    return (
        target
        if ignored is None
        else torch.where(ignored > 0, image.detach(), target)
    )
