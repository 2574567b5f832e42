"""LPIPS with pretrained weights, or the reason it cannot be had."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import torch
from torch import Tensor

from gsgan.data.measures import Measures
from gsgan.losses.weights import FILES, find_weights, how_to_get, load_weights
from gsgan.metrics.image import Score
from gsgan.utils.errors import ConfigError

_BACKBONES = {"vgg": "vgg16", "alex": "alexnet"}


def check_lpips(net: str, path: str | None) -> Path | None:
    """The backbone's weight file, or None where it is not at hand.

    Raises:
        ConfigError: on an unknown net.
        DataError: when a given path does not hold the weights.
    """
    if net not in _BACKBONES:
        raise ConfigError(f"lpips.net must be vgg or alex; got {net!r}")
    return find_weights(_BACKBONES[net], path)


def lpips_name(net: str, measures: Measures) -> str:
    """What LPIPS' numbers are called: backbone, values it is fed, and order of channels and region
    where those are not the usual ones."""
    backbone = {"vgg": "VGG", "alex": "Alex"}[net]
    low, high = measures.lpips_range
    order = "" if measures.lpips_channels == "rgb" else " BGR"
    region = "" if measures.lpips_region == "full" else " mask crop 512"
    return f"LPIPS-{backbone} [{low:g},{high:g}]{order}{region}"


def lpips(
    net: str = "vgg", path: str | None = None, value_range: tuple[float, float] = (-1.0, 1.0)
) -> tuple[Score | None, str]:
    """LPIPS with pretrained weights, or None with the reason it cannot be had.

    Never a score from random weights, and nothing is downloaded.

    Args:
        net: backbone, ``vgg`` or ``alex``.
        path: the backbone's torchvision weight file or its folder; None looks in the torch cache.
        value_range: (-1, 1) feeds what the backbone expects; (0, 1) feeds pictures as they are.

    Returns:
        (score, "") or (None, reason). The score clamps pictures to [0, 1].

    Raises:
        ConfigError: on an unknown net.
        DataError: when a given path does not hold the weights.
    """
    found = check_lpips(net, path)
    if found is None:
        backbone = _BACKBONES[net]
        return None, f"{backbone} weights are not at hand: {how_to_get(backbone)}"
    load_weights(found)  # refuses anything but a plain state dict before torchvision reads it
    metric = _build_lpips(net, found, scale=tuple(value_range) == (-1.0, 1.0))

    def score(image: Tensor, target: Tensor) -> Tensor:
        metric.to(image.device)
        pairs = zip(image.clamp(0, 1).split(1), target.clamp(0, 1).split(1), strict=True)
        with torch.no_grad():
            return torch.stack([metric(a, b) for a, b in pairs])

    return score, ""


def _build_lpips(net: str, weights: Path, scale: bool) -> torch.nn.Module:
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
            return LearnedPerceptualImagePatchSimilarity(net, normalize=scale).eval()  # type: ignore[arg-type]
        finally:
            torch.hub.set_dir(before)
