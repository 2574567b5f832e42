"""Scores of one picture against the truth: PSNR, SSIM, edge F1, LPIPS.

Convention: pictures ``[B, 3, H, W]``, RGB in [0, 1]; every function returns one score a picture,
``[B]``, because papers report the mean over pictures, not the score of pooled errors.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from gsgan.errors import ConfigError
from gsgan.losses.photometric import d_ssim_map
from gsgan.losses.weights import FILES, find_weights, how_to_get, load_weights

_BACKBONES = {"vgg": "vgg16", "alex": "alexnet"}


def psnr(image: Tensor, target: Tensor) -> Tensor:
    """Peak signal to noise ratio, dB; infinite for equal pictures (keep those out of means)."""
    error = (image - target).square().flatten(1).mean(dim=1)
    return -10 * error.log10()


def psnr_person(image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """PSNR inside the person's box, dB: the smallest box that holds the mask; NaN without one.

    A frame that is mostly background scores high whatever the person looks like.

    Args:
        image, target: pictures.
        mask: ``[B, 1, H, W]`` in [0, 1]; the person is where it is at least one half.
    """
    scores = []
    for a, b, m in zip(image, target, mask[:, 0] >= 0.5, strict=True):
        rows, columns = (m.any(dim=d).nonzero().flatten() for d in (1, 0))
        if len(rows) == 0:
            scores.append(image.new_tensor(float("nan")))
            continue
        box = (..., slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        scores.append(psnr(a[box][None], b[box][None])[0])
    return torch.stack(scores)


def high_frequencies(image: Tensor, target: Tensor, *, above: float = 0.25) -> Tensor:
    """Energy of the fine detail as a share of the truth's: 1 is as sharp, below 1 is blurred.

    Args:
        image, target: pictures; their grey values are compared.
        above: cycles a pixel from which a frequency counts as high (Nyquist is 0.5).

    Returns:
        The ratio; NaN where the truth has no such detail.
    """
    height, width = image.shape[-2:]
    rows = torch.fft.fftfreq(height, device=image.device)[:, None]
    columns = torch.fft.rfftfreq(width, device=image.device)[None]
    high = (rows.square() + columns.square()).sqrt() > above

    def energy(picture: Tensor) -> Tensor:
        spectrum = torch.fft.rfft2(picture.double().mean(dim=1))
        return (spectrum.abs().square() * high).sum(dim=(-2, -1))

    truth = energy(target)
    return torch.where(truth > 0, energy(image) / truth, torch.nan)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Structural similarity as torchmetrics defines it (Gaussian window 11, sigma 1.5).

    Not by torchmetrics' arithmetic, which in float32 gives two equal grey pictures 0.9991.
    """
    return 1 - d_ssim_map(image, target).flatten(1).mean(dim=1)


def edge_f1(
    image: Tensor, target: Tensor, *, low: float = 100.0, high: float = 200.0, tolerance: int = 1
) -> Tensor:
    """F1 of Canny edges against the truth's; NaN where the truth has no edge.

    Args:
        image, target: pictures.
        low, high: Canny's hysteresis thresholds on 8-bit grey.
        tolerance: pixels an edge may be off.
    """
    scores = [
        _edge_f1(_canny(a, low, high), _canny(b, low, high), tolerance)
        for a, b in zip(image, target, strict=True)
    ]
    return torch.tensor(scores)


def _canny(picture: Tensor, low: float, high: float) -> np.ndarray:
    rgb = (picture.detach().cpu().clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    return cv2.Canny(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), low, high) > 0


def _edge_f1(edges: np.ndarray, truth: np.ndarray, tolerance: int) -> float:
    if not truth.any():
        return float("nan")
    if not edges.any():
        return 0.0
    kernel = np.ones((2 * tolerance + 1, 2 * tolerance + 1), np.uint8)
    near_truth = cv2.dilate(truth.astype(np.uint8), kernel) > 0
    near_edges = cv2.dilate(edges.astype(np.uint8), kernel) > 0
    precision = (edges & near_truth).sum() / edges.sum()
    recall = (truth & near_edges).sum() / truth.sum()
    total = precision + recall
    return float(2 * precision * recall / total) if total else 0.0


Score = Callable[[Tensor, Tensor], Tensor]


def check_lpips(net: str, path: str | None) -> Path | None:
    """The backbone's weight file, or None where it is not at hand.

    Raises:
        ConfigError: on an unknown net.
        DataError: when a given path does not hold the weights.
    """
    if net not in _BACKBONES:
        raise ConfigError(f"lpips.net must be vgg or alex; got {net!r}")
    return find_weights(_BACKBONES[net], path)


def lpips(net: str = "vgg", path: str | None = None) -> tuple[Score | None, str]:
    """LPIPS with pretrained weights, or None with the reason it cannot be had.

    Never a score from random weights, and nothing is downloaded.

    Args:
        net: backbone, ``vgg`` or ``alex``.
        path: the backbone's torchvision weight file or its folder; None looks in the torch cache.

    Returns:
        (score, "") or (None, reason). The score clamps pictures to [0, 1] and feeds [-1, 1].

    Raises:
        ConfigError: on an unknown net.
        DataError: when a given path does not hold the weights.
    """
    found = check_lpips(net, path)
    if found is None:
        backbone = _BACKBONES[net]
        return None, f"{backbone} weights are not at hand: {how_to_get(backbone)}"
    load_weights(found)  # refuses anything but a plain state dict before torchvision reads it
    metric = _build_lpips(net, found)

    def score(image: Tensor, target: Tensor) -> Tensor:
        metric.to(image.device)
        pairs = zip(image.clamp(0, 1).split(1), target.clamp(0, 1).split(1), strict=True)
        with torch.no_grad():
            return torch.stack([metric(a, b) for a, b in pairs])

    return score, ""


def _build_lpips(net: str, weights: Path) -> torch.nn.Module:
    """torchmetrics' LPIPS, its backbone read from ``weights`` wherever that file lies."""
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    before = torch.hub.get_dir()
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "checkpoints"
        cache.mkdir()
        target = cache / FILES[_BACKBONES[net]]
        try:
            target.symlink_to(weights.resolve())
        except OSError:  # no links on this file system
            shutil.copyfile(weights, target)
        torch.hub.set_dir(folder)
        try:
            return LearnedPerceptualImagePatchSimilarity(net_type=net, normalize=True).eval()  # type: ignore[arg-type]
        finally:
            torch.hub.set_dir(before)
