"""Scores of images against the ground truth: PSNR, SSIM, high-frequency energy, edges.

Images are ``[B, 3, H, W]``, RGB in [0, 1]; every function returns one score per image,
``[B]``, because papers report the mean over images, not the score of pooled errors.
"""

from collections.abc import Callable

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from gsgan.losses.photometric import d_ssim_map
from gsgan.utils.arrays import Bool
from gsgan.utils.images import to_bytes

Score = Callable[[Tensor, Tensor], Tensor]
# K1 and K2 of Wang et al. 2004.
SSIM_CONSTANTS = (0.01, 0.03)
# Pixels: smaller images cannot be reflected by half of SSIM's window.
MIN_SIDE = 6
# Pixels on each side of the mask's outline.
OUTLINE_WIDTH = 2
# Pixels, scikit-image's default.
UNIFORM_WINDOW = 7


def psnr(image: Tensor, target: Tensor, pooling: str = "image") -> Tensor:
    """Peak signal-to-noise ratio in dB; infinite for equal images (leave those out of means).

    Args:
        image, target: images.
        pooling: "image", one error for all channels; "channels", the mean of their PSNRs.
    """
    # PSNR is -10 log10 of the mean squared error, for a peak of 1.
    error = (image - target).square().flatten(2).mean(dim=2)
    if pooling == "image":
        error = error.mean(dim=1, keepdim=True)
    return (-10 * error.log10()).mean(dim=1)


def psnr_where(
    image: Tensor,
    target: Tensor,
    where: Tensor,
    pooling: str = "image",
) -> Tensor:
    """PSNR of the pixels ``where [B, 1, H, W]`` in dB; NaN without any."""
    scores = []
    for predicted, truth, inside in zip(
        image, target, where[:, 0], strict=True
    ):
        # The pixels as an image of one column.
        own_pixels = predicted[None, :, inside, None]
        true_pixels = truth[None, :, inside, None]
        scores.append(psnr(own_pixels, true_pixels, pooling)[0])
    return torch.stack(scores)


def person_box(mask: Tensor) -> Tensor:
    """``[B, 1, H, W]`` bool: the smallest box around the mask's pixels of at least one half."""
    person = mask >= 0.5
    box = torch.ones_like(person)  # [B, 1, H, W]
    for along, across in ((-1, -2), (-2, -1)):
        # Rows, then columns: those at or after the first one and at or before the last one.
        held = person.any(dim=along, keepdim=True).long()
        started = held.cumsum(across) > 0
        unfinished = held.flip(across).cumsum(across).flip(across) > 0
        box &= started & unfinished
    return box


def flicker(
    image: Tensor,
    target: Tensor,
    mask: Tensor,
    before: tuple[Tensor, Tensor, Tensor],
) -> Tensor:
    """Mean |Δt image - Δt target| from the frame before to this one, in the box around the person
    in both; NaN if both masks are empty.

    Args:
        image, target: ``[1, C, H, W]``.
        mask: ``[1, 1, H, W]`` of the person.
        before: the same three of the frame before, seen by the same camera.
    """
    image_before, target_before, mask_before = before
    change = (image - image_before) - (target - target_before)
    change = change.abs().mean(dim=1, keepdim=True)
    box = person_box(torch.maximum(mask, mask_before))
    return change[box].mean()


def psnr_inside(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """PSNR in the person's box without the pixels within `OUTLINE_WIDTH` of the mask's outline.

    Their error is due to the mask if masks are uneven. The score is NaN if the mask is empty.
    """
    return psnr_where(image, target, person_box(mask) & ~outline(mask))


def outline(mask: Tensor) -> Tensor:
    """``[B, 1, H, W]`` bool: the pixels within `OUTLINE_WIDTH` of the mask's outline."""
    # Dilated and eroded masks differ there; OpenCV's filters are separable.
    side = 2 * OUTLINE_WIDTH + 1
    kernel = np.ones((side, side), np.uint8)
    borders = []
    for person in (mask[:, 0] >= 0.5).cpu().numpy().astype(np.uint8):
        gradient = cv2.morphologyEx(person, cv2.MORPH_GRADIENT, kernel)
        borders.append(torch.from_numpy(gradient > 0))
    return torch.stack(borders).unsqueeze(1).to(mask.device)


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """``[B, 1, H, W]`` SSIM at every pixel, mean over channels; NaN everywhere if a side is shorter
    than `MIN_SIDE`."""
    if min(image.shape[-2:]) < MIN_SIDE:
        return torch.full_like(image[:, :1], torch.nan)
    return 1 - d_ssim_map(image, target).mean(dim=1, keepdim=True)


def ssim_where(similar: Tensor, region: Tensor) -> Tensor:
    """The mean ``[B]`` of `ssim_map` over a region ``[B, 1, H, W]``; its windows reach beyond the
    region, and it is NaN for an empty one."""
    total = (similar * region).flatten(1).sum(dim=1)
    return total / region.flatten(1).sum(dim=1)


def ssim(image: Tensor, target: Tensor, *, value_range: float = 1.0) -> Tensor:
    """Structural similarity as torchmetrics defines it (Gaussian window 11, sigma 1.5).

    The arithmetic differs: in float32 torchmetrics gives two equal grey images 0.9991.

    Args:
        image, target: images; the score is NaN if a side is shorter than `MIN_SIDE`.
        value_range: of the values; 1 is correct for [0, 1].
    """
    if min(image.shape[-2:]) < MIN_SIDE:
        return image.new_full((len(image),), torch.nan)
    k1, k2 = SSIM_CONSTANTS
    k = (k1 * value_range, k2 * value_range)
    return 1 - d_ssim_map(image, target, k=k).flatten(1).mean(dim=1)


def ssim_uniform(
    image: Tensor, target: Tensor, *, value_range: float = 1.0
) -> Tensor:
    """Structural similarity with scikit-image's defaults: a uniform window of 7 pixels, sample
    covariances, no windows across the border.

    Args:
        image, target: images; the score is NaN if a side is shorter than the window.
        value_range: of the values; 1 is correct for [0, 1].
    """
    window = UNIFORM_WINDOW
    if min(image.shape[-2:]) < window:
        return image.new_full((len(image),), torch.nan)

    # Means over each window of x, y, x², y² and x y.
    x = image.double()
    y = target.double()
    squares = [x, y, x * x, y * y, x * y]
    moments = torch.cat(squares, dim=1)
    local = functional.avg_pool2d(moments, window, 1)
    mean_x, mean_y, xx, yy, xy = local.chunk(5, dim=1)

    # Sample covariance, and the sum of both sample variances.
    sample = window**2 / (window**2 - 1)
    covariance = sample * (xy - mean_x * mean_y)
    variances = sample * (xx - mean_x.square() + yy - mean_y.square())

    # (2 μx μy + C1) (2 cov + C2) / ((μx² + μy² + C1) (var x + var y + C2))
    k1, k2 = SSIM_CONSTANTS
    c1 = (k1 * value_range) ** 2
    c2 = (k2 * value_range) ** 2
    power = mean_x.square() + mean_y.square()
    luminance = (2 * mean_x * mean_y + c1) / (power + c1)
    similar = luminance * (2 * covariance + c2) / (variances + c2)
    return similar.flatten(1).mean(dim=1).to(image.dtype)


def high_frequencies(
    image: Tensor, target: Tensor, *, above: float = 0.25
) -> Tensor:
    """High-frequency energy relative to the ground truth's: below 1 is blurred, noise raises it.

    Args:
        image, target: images; their grey values are compared.
        above: cycles per pixel above which a frequency counts as high (Nyquist is 0.5).

    Returns:
        The ratio; NaN if the ground truth has no such detail.
    """
    # The frequencies of a real spectrum: half of the columns are enough.
    height, width = image.shape[-2:]
    # cycles per pixel
    rows = torch.fft.fftfreq(height, device=image.device)[:, None]
    columns = torch.fft.rfftfreq(width, device=image.device)[None]
    high = (rows.square() + columns.square()).sqrt() > above

    def energy(x: Tensor) -> Tensor:
        grey = x.double().mean(dim=1)
        power = torch.fft.rfft2(grey).abs().square()
        return (power * high).sum(dim=(-2, -1))

    # Energy is the sum of squared magnitudes at high frequencies.
    truth = energy(target)
    return torch.where(truth > 0, energy(image) / truth, torch.nan)


def edge_f1(image: Tensor, target: Tensor) -> Tensor:
    """F1 of Canny edges, see `edge_scores`."""
    f1, _ = edge_scores(image, target)
    return f1


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
        Two float64 ``[B]``; NaN if the ground truth has no edge.
    """
    scores = []
    side = 2 * tolerance + 1
    kernel = np.ones((side, side), np.uint8)
    for i, (predicted, true) in enumerate(zip(image, target, strict=True)):
        edges = _canny(predicted, low, high)
        truth = _canny(true, low, high)

        # Pixels within the tolerance of an edge.
        near_edges = cv2.dilate(edges.astype(np.uint8), kernel) > 0
        near_truth = cv2.dilate(truth.astype(np.uint8), kernel) > 0

        # Edges elsewhere do not count, but may confirm edges that do.
        if where is not None:
            inside = where[i, 0].cpu().numpy()
            edges = edges & inside
            truth = truth & inside

        # Without true edges, neither precision nor recall is defined.
        count = edges.sum()
        expected = truth.sum()
        if not expected:
            scores.append((np.nan, np.nan))
            continue

        # F1 is the harmonic mean of precision and recall.
        precision = (edges & near_truth).sum() / max(count, 1)
        recall = (truth & near_edges).sum() / expected

        # The harmonic mean of both; 0 if no edge is near.
        f1 = 0.0
        total = precision + recall
        if total:
            f1 = 2 * precision * recall / total
        scores.append((f1, count / expected))
    f1s, ratios = torch.tensor(scores, dtype=torch.float64).unbind(1)
    return f1s, ratios


def _canny(image: Tensor, low: float, high: float) -> Bool:
    """``[H, W]`` the edges of an image ``[3, H, W]``, with Canny's two thresholds."""
    grey = cv2.cvtColor(to_bytes(image), cv2.COLOR_RGB2GRAY)
    return cv2.Canny(grey, low, high) > 0
