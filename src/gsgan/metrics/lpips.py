"""LPIPS with pretrained weights, or the reason why there is none."""

import tempfile
from pathlib import Path

import torch
from torch import Tensor

from gsgan.losses.perceptual import FILES, find_weights, how_to_get, load_weights
from gsgan.metrics.image import Score
from gsgan.utils.errors import ConfigError

_BACKBONES = {"vgg": "vgg16", "alex": "alexnet"}


def check_lpips(net: str, path: str | None) -> Path | None:
    """The backbone's weight file, or None if there is none.

    Raises:
        ConfigError: on an unknown net.
        DataError: when a given path has no weights.
    """
    if net not in _BACKBONES:
        raise ConfigError(f"lpips.net must be vgg or alex; got {net!r}")
    return find_weights(_BACKBONES[net], path)


def lpips(
    net: str = "vgg", path: str | None = None, value_range: tuple[float, float] = (-1.0, 1.0)
) -> tuple[Score | None, str]:
    """LPIPS with pretrained weights, or None with the reason; weights are never random and never
    downloaded.

    Args:
        net: backbone, ``vgg`` or ``alex``.
        path: the backbone's torchvision weight file or its folder; None looks in the torch cache.
        value_range: (-1, 1) scales images as the backbone expects; (0, 1) leaves them unscaled.

    Returns:
        (score, "") or (None, reason). The score clamps images to [0, 1].

    Raises:
        ConfigError: on an unknown net.
        DataError: when a given path has no weights.
    """
    found = check_lpips(net, path)
    if found is None:
        backbone = _BACKBONES[net]
        return None, f"{backbone} weights are not available: {how_to_get(backbone)}"
    load_weights(found)  # refuses anything but a plain state dict before torchvision reads it
    metric = _build_lpips(net, found, scale=tuple(value_range) == (-1.0, 1.0))

    def score(image: Tensor, target: Tensor) -> Tensor:
        metric.to(image.device)
        pairs = zip(image.clamp(0, 1).split(1), target.clamp(0, 1).split(1), strict=True)
        with torch.no_grad():
            return torch.stack([metric(a, b) for a, b in pairs])

    return score, ""


def _build_lpips(net: str, weights: Path, scale: bool) -> torch.nn.Module:
    """torchmetrics' LPIPS, which reads only from the torch cache, with the backbone ``weights``."""
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    before = torch.hub.get_dir()
    with tempfile.TemporaryDirectory() as folder:
        cache = Path(folder) / "checkpoints"
        cache.mkdir()
        (cache / FILES[_BACKBONES[net]]).symlink_to(weights.resolve())
        torch.hub.set_dir(folder)
        try:
            return LearnedPerceptualImagePatchSimilarity(net, normalize=scale).eval()  # type: ignore[arg-type]
        finally:
            torch.hub.set_dir(before)
