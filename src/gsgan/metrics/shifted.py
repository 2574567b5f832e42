"""PSNR without the error of place: what is a pixel off does not count."""

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.metrics.image import person_box
from gsgan.metrics.regions import rectangle

# Pixels: the side of a block, and how far it is moved at most in each direction.
BLOCK = 16
MAX_SHIFT = 1


def psnr_shifted(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """PSNR in the person's box in dB, with each block of `BLOCK` pixels of the image moved by
    up to `MAX_SHIFT` pixels, in steps of half a pixel, to where its squared error is least.

    Blocks start at the box's upper left corner; those at its other ends are smaller.

    Args:
        image, target: ``[1, 3, H, W]``.
        mask: ``[1, 1, H, W]`` of the person.

    Returns:
        A scalar, never below the PSNR in the box; NaN if the mask is empty, infinite if
        every block fits exactly.
    """
    part = rectangle(person_box(mask)[0])
    if part is None:
        return image.new_tensor(torch.nan)
    rows, columns = part
    truth = target[..., rows, columns]
    height, width = truth.shape[-2:]

    # The box and `MAX_SHIFT` pixels around it, with cubic values halfway between the pixels.
    padded = functional.pad(
        image, (MAX_SHIFT, MAX_SHIFT, MAX_SHIFT, MAX_SHIFT), mode="replicate"
    )
    bottom = rows.stop + 2 * MAX_SHIFT
    right = columns.stop + 2 * MAX_SHIFT
    around = padded[..., rows.start : bottom, columns.start : right]
    size = (2 * around.shape[-2] - 1, 2 * around.shape[-1] - 1)
    fine = functional.interpolate(
        around, size, mode="bicubic", align_corners=True
    )
    fine[..., ::2, ::2] = around  # exact

    # The sums of squared errors of all blocks, by shift.
    beyond = (0, -width % BLOCK, 0, -height % BLOCK)
    sums = []
    for y in range(4 * MAX_SHIFT + 1):
        for x in range(4 * MAX_SHIFT + 1):
            # A step in the finer image is half a pixel.
            moved = fine[..., y:, x:][..., ::2, ::2][..., :height, :width]
            squared = (moved - truth).square().mean(dim=1, keepdim=True)
            blocks = functional.pad(squared, beyond)
            sums.append(
                functional.avg_pool2d(blocks, BLOCK, divisor_override=1)
            )

    # Every block takes its best shift.
    least = torch.stack(sums).amin(dim=0)
    return -10 * (least.sum() / (height * width)).log10()
