"""Scores of images against the ground truth: PSNR, SSIM, high-frequency energy, edges.

Convention: images ``[B, 3, H, W]``, RGB in [0, 1]; every function returns one score per image,
``[B]``, because papers report the mean over images, not the score of pooled errors.
"""

from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsgan.losses.photometric import d_ssim_map
from gsgan.utils.images import to_bytes

Score = Callable[[Tensor, Tensor], Tensor]
SSIM_CONSTANTS = (0.01, 0.03)
LEAST_SIDE = 6  # pixels: smaller images cannot be reflected by half of SSIM's window
OUTLINE = 2  # pixels
UNIFORM_WINDOW = 7  # pixels, scikit-image's default


def psnr(image: Tensor, target: Tensor, pooling: str = "image") -> Tensor:
    """Peak signal-to-noise ratio in dB; infinite for equal images (leave those out of means).

    Args:
        image, target: images.
        pooling: "image", one error for all channels; "channels", the mean of their PSNRs.
    """
    error = (image - target).square().flatten(2).mean(dim=2)
    if pooling == "image":
        error = error.mean(dim=1, keepdim=True)
    return (-10 * error.log10()).mean(dim=1)


def psnr_where(
    image: Tensor, target: Tensor, where: Tensor, pooling: str = "image"
) -> Tensor:
    """PSNR of the pixels ``where [B, 1, H, W]`` in dB; NaN without any."""
    scores = [
        psnr(a[None, :, m, None], b[None, :, m, None], pooling)[0]
        for a, b, m in zip(image, target, where[:, 0], strict=True)
    ]
    return torch.stack(scores)


def person_box(mask: Tensor) -> Tensor:
    """``[B, 1, H, W]`` bool: the smallest box around the mask's pixels of at least one half."""
    person = mask >= 0.5
    box = torch.ones_like(person)
    # rows, columns from the first to the last
    for along, across in ((-1, -2), (-2, -1)):
        held = person.any(dim=along, keepdim=True).long()
        box &= (held.cumsum(across) > 0) & (
            held.flip(across).cumsum(across).flip(across) > 0
        )
    return box


def flicker(
    image: Tensor, target: Tensor, mask: Tensor, before: tuple[Tensor, Tensor, Tensor]
) -> Tensor:
    """Mean |Δt image - Δt target| from the frame before to this one, in the box round the person
    in both; NaN where both masks are empty.

    Args:
        image, target: ``[1, C, H, W]``.
        mask: ``[1, 1, H, W]`` of the person.
        before: the same three of the frame before, seen by the same camera.
    """
    change = (
        ((image - before[0]) - (target - before[1])).abs().mean(dim=1, keepdim=True)
    )
    return change[person_box(torch.maximum(mask, before[2]))].mean()


def psnr_inside(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """PSNR in the person's box without the pixels within `OUTLINE` of the mask's outline, whose
    error is due to the mask where masks are uneven; NaN where the mask is empty."""
    person = (mask >= 0.5).to(mask)
    side = 2 * OUTLINE + 1
    dilated, shrunk = (
        s * functional.max_pool2d(s * person, side, 1, OUTLINE) for s in (1, -1)
    )
    return psnr_where(image, target, person_box(mask) & (dilated == shrunk))


def ssim_where(image: Tensor, target: Tensor, *regions: Tensor) -> list[Tensor]:
    """SSIM's mean over each region ``[B, 1, H, W]``, with windows that reach beyond it; NaN for an
    empty region."""
    similar = (1 - d_ssim_map(image, target)).mean(dim=1, keepdim=True)
    return [
        (similar * r).flatten(1).sum(dim=1) / r.flatten(1).sum(dim=1) for r in regions
    ]


def ssim(image: Tensor, target: Tensor, *, value_range: float = 1.0) -> Tensor:
    """Structural similarity as torchmetrics defines it (Gaussian window 11, sigma 1.5).

    The arithmetic differs: in float32 torchmetrics gives two equal grey images 0.9991.

    Args:
        image, target: images; NaN where a side is shorter than `LEAST_SIDE`.
        value_range: of the values; 1 is correct for [0, 1].
    """
    if min(image.shape[-2:]) < LEAST_SIDE:
        return image.new_full((len(image),), torch.nan)
    first, second = SSIM_CONSTANTS
    k = (first * value_range, second * value_range)
    return 1 - d_ssim_map(image, target, k=k).flatten(1).mean(dim=1)


def ssim_uniform(image: Tensor, target: Tensor, *, value_range: float = 1.0) -> Tensor:
    """Structural similarity with scikit-image's defaults: a uniform window of 7 pixels, sample
    covariances, no windows across the border.

    Args:
        image, target: images; NaN where a side is shorter than the window.
        value_range: of the values; 1 is correct for [0, 1].
    """
    window = UNIFORM_WINDOW
    if min(image.shape[-2:]) < window:
        return image.new_full((len(image),), torch.nan)
    x = image.double()
    y = target.double()
    moments = torch.cat([x, y, x * x, y * y, x * y], dim=1)
    mean_x, mean_y, xx, yy, xy = functional.avg_pool2d(moments, window, 1).chunk(
        5, dim=1
    )
    sample = window**2 / (window**2 - 1)
    both = sample * (xy - mean_x * mean_y)
    spread = sample * (xx - mean_x.square() + yy - mean_y.square())
    first, second = ((k * value_range) ** 2 for k in SSIM_CONSTANTS)
    luminance = (2 * mean_x * mean_y + first) / (
        mean_x.square() + mean_y.square() + first
    )
    similar = luminance * (2 * both + second) / (spread + second)
    return similar.flatten(1).mean(dim=1).to(image.dtype)


def high_frequencies(image: Tensor, target: Tensor, *, above: float = 0.25) -> Tensor:
    """High-frequency energy relative to the ground truth's: below 1 is blurred, noise raises it.

    Args:
        image, target: images; their grey values are compared.
        above: cycles per pixel above which a frequency counts as high (Nyquist is 0.5).

    Returns:
        The ratio; NaN where the ground truth has no such detail.
    """
    height, width = image.shape[-2:]
    rows = torch.fft.fftfreq(height, device=image.device)[:, None]
    columns = torch.fft.rfftfreq(width, device=image.device)[None]
    high = (rows.square() + columns.square()).sqrt() > above

    def energy(x: Tensor) -> Tensor:
        spectrum = torch.fft.rfft2(x.double().mean(dim=1))
        return (spectrum.abs().square() * high).sum(dim=(-2, -1))

    truth = energy(target)
    return torch.where(truth > 0, energy(image) / truth, torch.nan)


def edge_f1(image: Tensor, target: Tensor) -> Tensor:
    """The first of `edge_scores`."""
    return edge_scores(image, target)[0]


def edge_scores(
    image: Tensor,
    target: Tensor,
    where: Tensor | None = None,
    *,
    low: float = 100.0,
    high: float = 200.0,
    tolerance: int = 1,
) -> tuple[Tensor, Tensor]:
    """F1 of Canny edges, and the ratio of their number to the ground truth's (1 is best).

    Args:
        image, target: images.
        where: ``[B, 1, H, W]`` bool: only edges in it are counted.
        low, high: Canny's hysteresis thresholds on 8-bit grey.
        tolerance: pixels an edge may be off.

    Returns:
        Two float64 ``[B]``; NaN where the ground truth has no edge.
    """
    scores = []
    kernel = np.ones((2 * tolerance + 1, 2 * tolerance + 1), np.uint8)
    for i, pair in enumerate(zip(image, target, strict=True)):
        grey = (cv2.cvtColor(to_bytes(x), cv2.COLOR_RGB2GRAY) for x in pair)
        edges, truth = (cv2.Canny(x, low, high) > 0 for x in grey)
        near = [cv2.dilate(x.astype(np.uint8), kernel) > 0 for x in (edges, truth)]
        if where is not None:
            inside = where[i, 0].cpu().numpy()
            edges = edges & inside
            truth = truth & inside
        count = edges.sum()
        expected = truth.sum()
        if not expected:
            scores.append((np.nan, np.nan))
            continue
        precision = (edges & near[1]).sum() / max(count, 1)
        recall = (truth & near[0]).sum() / expected
        total = precision + recall
        scores.append(
            (2 * precision * recall / total if total else 0.0, count / expected)
        )
    f1, ratio = torch.tensor(scores, dtype=torch.float64).unbind(1)
    return f1, ratio
