"""L_perc: distance between features of a pretrained VGG-16, or of a marked random network."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.nn import functional

from gsgan.utils.errors import ConfigError, DataError

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
FILES = {"vgg16": "vgg16-397923af.pth", "alexnet": "alexnet-owt-7be5be79.pth"}
VGG_TAPS = (3, 8, 15, 22)  # relu1_2, relu2_2, relu3_3, relu4_3 in torchvision's vgg16.features


class Perceptual(nn.Module):
    """Squared feature distance, the layers weighted by the inverse of their first losses.

    No weights are published for these layers, so they are measured: each layer's weight is the
    inverse of its mean loss over the first ``warmup`` calls of all processes (weights sum to 1),
    then frozen and stored in the checkpoint.

    Args:
        weights: ``vgg16`` (its file must exist), ``auto`` (vgg16 if its file exists, else a small
            network with fixed random weights, marked as such), or ``random``.
        path: the weight file or its folder; None looks in the torch cache.
        warmup: number of calls over which layer weights are measured.
        width: channels of the random network's first layer.

    Raises:
        ConfigError: on an unknown ``weights``.
        DataError: when ``vgg16`` was requested and its file does not exist.

    Source: paper Sec. 3.5.
    """

    mean: Tensor
    std: Tensor
    layer_loss: Tensor
    calls: Tensor

    def __init__(
        self, weights: str = "auto", path: str | None = None, *, warmup: int = 50, width: int = 16
    ) -> None:
        super().__init__()
        if weights not in ("vgg16", "auto", "random"):
            raise ConfigError(f"perceptual.weights must be vgg16, auto or random; got {weights!r}")
        found = None if weights == "random" else find_weights("vgg16", path)
        if weights == "vgg16" and found is None:
            raise DataError(f"VGG-16's weights were not found: {how_to_get('vgg16')}")
        self.stages = _vgg_stages(found) if found else _random_stages(width)
        self.mark = None if found else "perceptual loss: fixed random network, not VGG-16"
        self.requires_grad_(False)
        # Fixed weights, restored from a file or a seed, are not stored in checkpoints.
        self.stages.register_state_dict_post_hook(_leave_out)
        self.register_load_state_dict_pre_hook(_put_back)
        self.warmup = warmup
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1))
        self.register_buffer("layer_loss", torch.zeros(len(self.stages)))
        self.register_buffer("calls", torch.zeros((), dtype=torch.long))

    def features(self, image: Tensor) -> list[Tensor]:
        """Feature maps of images ``[B, 3, H, W]`` in [0, 1]."""
        x, maps = (image - self.mean) / self.std, []
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        return maps

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        """The weighted distance; the target's features take no gradient."""
        with torch.no_grad():
            truth = self.features(target)
        losses = torch.stack(
            [functional.mse_loss(a, b) for a, b in zip(self.features(image), truth, strict=True)]
        )
        if self.training:  # without reading `calls`, for which the host would wait
            warm = self.calls < self.warmup
            self.calls += warm
            step = (_over_processes(losses.detach()) - self.layer_loss) / self.calls
            self.layer_loss += torch.where(warm, step, 0.0)
        inverse = 1 / self.layer_loss.clamp_min(1e-12)
        return (losses * inverse / inverse.sum()).sum()


def _over_processes(value: Tensor) -> Tensor:
    """The mean over the processes of a training."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return value
    value = value.clone()
    distributed.all_reduce(value)
    return value / distributed.get_world_size()


def _leave_out(module: nn.Module, state: dict[str, Any], prefix: str, _: Any) -> None:
    for key in [key for key in state if key.startswith(prefix)]:
        del state[key]


def _put_back(module: nn.Module, state: dict[str, Any], prefix: str, *_: Any) -> None:
    for key, value in nn.Module.named_parameters(module.stages):  # type: ignore[arg-type]
        state.setdefault(f"{prefix}stages.{key}", value.detach())


def _vgg_stages(path: Path) -> nn.ModuleList:
    from torchvision.models.vgg import cfgs, make_layers  # heavy: only where it is used

    layers = make_layers(cfgs["D"])  # without the classifier, nine tenths of the weights
    found = {k[9:]: v for k, v in load_weights(path).items() if k.startswith("features.")}
    try:
        layers.load_state_dict(found)
    except RuntimeError as error:
        raise DataError(f"{path}: these are not torchvision's VGG-16 weights") from error
    for layer in layers:
        if isinstance(layer, nn.ReLU):
            layer.inplace = False
    bounds = [0, *(tap + 1 for tap in VGG_TAPS)]
    return nn.ModuleList(nn.Sequential(*layers[a:b]) for a, b in pairwise(bounds))


def _random_stages(width: int) -> nn.ModuleList:
    """Three small stages with fixed weights, independent of the run's seed."""
    generator = torch.Generator().manual_seed(20250717)
    stages, channels = [], [3, width, 2 * width, 4 * width]
    for i, (a, b) in enumerate(pairwise(channels)):
        conv = nn.Conv2d(a, b, 3, stride=1 if i == 0 else 2, padding=1)
        with torch.no_grad():
            conv.weight.normal_(0, (2 / (9 * a)) ** 0.5, generator=generator)
            conv.bias.zero_()  # type: ignore[union-attr]
        stages.append(nn.Sequential(conv, nn.LeakyReLU(0.2)))
    return nn.ModuleList(stages)


# -- pretrained torchvision weights; nothing is downloaded


def find_weights(name: str, path: str | Path | None = None) -> Path | None:
    """The weight file of torchvision's ``vgg16`` or ``alexnet``, or None if there is none.

    Args:
        name: of the network.
        path: the file or its folder; None looks in the torch cache.

    Raises:
        DataError: when a path was given and the file does not exist.
    """
    if path is None:
        cached = Path(torch.hub.get_dir()) / "checkpoints" / FILES[name]
        return cached if cached.is_file() else None
    given = Path(path).expanduser()
    found = given / FILES[name] if given.is_dir() else given
    if not found.is_file():
        raise DataError(f"{found}: no such file; expected torchvision's {name} weights there")
    return found


def how_to_get(name: str) -> str:
    """How to install the weights, as a clause of a message."""
    return (
        f"put torchvision's {FILES[name]} into $TORCH_HOME/hub/checkpoints "
        "(~/.cache/torch/hub/checkpoints unless set) or give its path"
    )


def load_weights(path: Path) -> dict[str, torch.Tensor]:
    """Reads a state dict without unrestricted pickle.

    Raises:
        DataError: when the file is not a plain state dict.
    """
    try:
        return dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:
        raise DataError(
            f"{path}: not a readable torchvision weight file ({type(error).__name__}); "
            "download it again"
        ) from error
