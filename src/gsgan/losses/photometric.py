"""L1 and D-SSIM, as Step I uses them (paper Eq. for L_Ψ)."""

from __future__ import annotations

from kornia.losses import ssim_loss
from torch import Tensor

from gsgan.precision import full_precision

SSIM_WINDOW = 11


def d_ssim(image: Tensor, target: Tensor) -> Tensor:
    """1 - SSIM, mean over pixels: 11×11 Gaussian window, pictures ``[B, 3, H, W]`` in [0, 1].

    kornia returns (1 - SSIM) / 2; 3DGS and this paper weigh 1 - SSIM, so it is doubled.
    """
    with full_precision(image):  # variances are differences of near-equal numbers
        return 2 * ssim_loss(image, target, SSIM_WINDOW)


def photometric(
    image: Tensor, target: Tensor, *, l1: float = 0.8, l2: float = 0.0, ssim: float = 0.2
) -> Tensor:
    """Weighted L1, squared error and D-SSIM; a term of weight 0 is not computed."""
    difference = image - target
    loss = difference.new_zeros(())
    if l1:
        loss = loss + l1 * difference.abs().mean()
    if l2:
        loss = loss + l2 * difference.square().mean()
    if ssim:
        loss = loss + ssim * d_ssim(image, target)
    return loss
