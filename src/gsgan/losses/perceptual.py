"""L_perc: distance between features of a pretrained network, in the whole image or in crops."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.nn import functional

from gsgan.utils.checks import integer, one_of
from gsgan.weights.files import NETWORKS
from gsgan.weights.networks import (
    MIN_PIXELS,
    FeatureNetwork,
    Lpips,
    load_pretrained,
)

FEATURES = "features"
LPIPS = "lpips"
PRETRAINED = "pretrained"
RANDOM = "random"
# relu1_2, relu2_2, relu3_3, relu4_3, as Johnson et al.
VGG_LAYERS = 4
# Weight of a pixel off the person, so that a crop exists without a person.
ANYWHERE = 1e-6


class Perceptual(nn.Module):
    """Perceptual distance of two images, in the whole image or in crops of the person.

    The form ``features`` is the squared distance of the features, each layer weighted by the
    inverse of its first losses. The paper does not give the weights of the layers, so they are
    measured: each is the inverse of the layer's mean loss over the first ``warmup`` calls of all
    processes (the weights sum to 1), then it is frozen and stored in the checkpoint. The form
    ``lpips`` is LPIPS, whose weights of the layers were learnt from people's judgements.

    Args:
        weights: ``pretrained``, or ``random``, a small network with fixed random weights, for tests
            that need no weights; tables mark it.
        net: ``vgg`` or ``alex``, the pretrained network.
        form: ``features`` or ``lpips``.
        path: of the pretrained weights, see `gsgan.weights.files.find`.
        crop: side of the compared squares in pixels, around random pixels of the person; None
            compares the whole image.
        crops: number of squares of each image.
        warmup: number of calls over which the layers' weights are measured.
        width: channels of the random network's first layer.

    Raises:
        ConfigError: on a value that is not one of the above.
        DataError: if pretrained weights are not found and cannot be downloaded.

    Source: paper Sec. 3.5, without crops and the form ``lpips``.
    """

    layer_loss: Tensor
    calls: Tensor

    def __init__(
        self,
        weights: str = PRETRAINED,
        *,
        net: str = "vgg",
        form: str = FEATURES,
        path: str | None = None,
        crop: int | None = None,
        crops: int = 1,
        warmup: int = 50,
        width: int = 16,
    ) -> None:
        super().__init__()

        # The options as they are called in configs.
        key = "training.perceptual"
        one_of(f"{key}.weights", weights, (PRETRAINED, RANDOM))
        one_of(f"{key}.net", net, ("vgg", "alex"))
        one_of(f"{key}.form", form, (FEATURES, LPIPS))
        if crop is not None:
            integer(f"{key}.crop", crop, MIN_PIXELS)
        self.crop = crop
        self.crops = integer(f"{key}.crops", crops, 1)
        self.warmup = warmup

        # The network, its description, and a mark for tables if it is only for tests.
        self.network: FeatureNetwork | Lpips
        self.mark = None
        self.description = f"{NETWORKS[net].title}, {form}"

        # A random network, LPIPS with its learnt weights, or the features
        # alone.
        if weights == RANDOM:
            self.network = FeatureNetwork(_random_stages(width))
            self.mark = "perceptual loss: fixed random network, not VGG-16"
            self.description = "a fixed random network"
        elif form == LPIPS:
            self.network = Lpips(net, path)
        else:
            self.network = load_pretrained(net, path)
            if net == "vgg":
                self.network.stages = self.network.stages[:VGG_LAYERS]
        if crop is not None:
            self.description += (
                f", {crops} of {crop}² around the person in each image"
            )

        # The mean loss of each layer over the first calls; LPIPS is one number.
        layers = 1
        if isinstance(self.network, FeatureNetwork):
            layers = len(self.network.stages)
        self.register_buffer("layer_loss", torch.zeros(layers))
        self.register_buffer("calls", torch.zeros((), dtype=torch.long))

        # Fixed weights, restored from a file or a seed, are not stored in checkpoints.
        self.network.register_state_dict_post_hook(_leave_out)
        self.register_load_state_dict_pre_hook(_put_back)

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        """The distance of ``image`` and ``target``, both ``[B, 3, H, W]``, RGB in [0, 1]; the
        target's features take no gradient."""
        if isinstance(self.network, Lpips):
            with torch.no_grad():
                truth = self.network.features(target)
            return self.network.distance(
                self.network.features(image), truth
            ).mean()

        # The squared distance of each layer's features.
        with torch.no_grad():
            truth = self.network(target)
        losses = []
        for ours, theirs in zip(self.network(image), truth, strict=True):
            losses.append(functional.mse_loss(ours, theirs))
        loss = torch.stack(losses)

        # The running mean of the layers' losses until warm-up ends: m += (loss - m) / calls. The
        # host does not read `calls`, for which it would wait for the device.
        if self.training:
            warm = self.calls < self.warmup
            self.calls += warm
            step = (
                _over_processes(loss.detach()) - self.layer_loss
            ) / self.calls
            self.layer_loss += torch.where(warm, step, 0.0)

        # Weights are the inverse means, scaled to a sum of 1.
        inverse = 1 / self.layer_loss.clamp_min(1e-12)
        return (loss * inverse / inverse.sum()).sum()


@dataclass(frozen=True)
class PerceptualSettings:
    """Settings of `Perceptual`: the key ``training.perceptual``."""

    weights: str
    net: str
    form: str
    path: str | None
    crop: int | None
    crops: int
    warmup: int
    width: int

    def build(self) -> Perceptual:
        """The loss, with its network."""
        return Perceptual(**vars(self))


def crop_person(
    images: Sequence[Tensor],
    mask: Tensor,
    draws: Tensor,
    size: int,
) -> list[Tensor]:
    """Cuts the same squares around random pixels of the person out of several images.

    A square that would leave the image is moved inside; an image smaller than the square gives all
    of its rows or columns; without a person the squares are anywhere. The host does not wait for
    the device.

    Args:
        images: each ``[B, C, H, W]``.
        mask: ``[B, 1, H, W]``, the probability of each pixel is proportional to it.
        draws: ``[B, N]`` uniform random numbers in [0, 1).
        size: side in pixels.

    Returns:
        Each image's squares, ``[B * N, C, size, size]``.
    """
    height, width = mask.shape[-2:]
    rows = min(size, height)
    columns = min(size, width)

    # The pixel at which the cumulative mask reaches the random share of its total.
    cumulative = (mask.flatten(1).double() + ANYWHERE).cumsum(dim=1)
    shares = draws.to(cumulative) * cumulative[:, -1:]
    centre = torch.searchsorted(cumulative, shares, right=True)
    centre = centre.clamp(max=height * width - 1)

    # The corner of the square around it, moved inside the image.
    top = (centre // width - rows // 2).clamp(0, height - rows)
    left = (centre % width - columns // 2).clamp(0, width - columns)
    y = top[..., None] + torch.arange(rows, device=mask.device)  # [B, N, rows]
    # [B, N, columns]
    x = left[..., None] + torch.arange(columns, device=mask.device)

    # One gather per image: [B, N, rows, columns, C].
    batch = torch.arange(len(mask), device=mask.device)[:, None, None, None]
    y = y[..., :, None]
    x = x[..., None, :]

    # All squares of all images at once, by their indices.
    cut = []
    for image in images:
        squares = image.movedim(1, -1)[batch, y, x]
        cut.append(squares.flatten(0, 1).movedim(-1, 1))
    return cut


def _over_processes(value: Tensor) -> Tensor:
    """The mean over the processes of a training."""
    if not (distributed.is_available() and distributed.is_initialized()):
        return value

    # The sum replaces its argument, so a copy is given.
    value = value.clone()
    distributed.all_reduce(value)
    return value / distributed.get_world_size()


def _leave_out(
    module: nn.Module, state: dict[str, Any], prefix: str, _: Any
) -> None:
    """Removes a module's weights from a state dict."""
    for key in list(state):
        if key.startswith(prefix):
            del state[key]


def _put_back(
    module: nn.Module, state: dict[str, Any], prefix: str, *_: Any
) -> None:
    """Adds the network's weights to a state dict that lacks them, as strict loading requires."""
    network = module.get_submodule("network")
    for key, value in [*network.named_parameters(), *network.named_buffers()]:
        state.setdefault(f"{prefix}network.{key}", value.detach())


def _random_stages(width: int) -> nn.ModuleList:
    """Three small stages with fixed weights, independent of the run's seed."""
    generator = torch.Generator().manual_seed(20250717)
    stages = []
    stride = 1
    for inputs, outputs in pairwise([3, width, 2 * width, 4 * width]):
        # Each stage but the first halves the image.
        conv = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)
        stride = 2

        # He's initialisation, by a generator of its own.
        with torch.no_grad():
            conv.weight.normal_(
                0, (2 / (9 * inputs)) ** 0.5, generator=generator
            )
            conv.bias.zero_()  # type: ignore[union-attr]
        stages.append(nn.Sequential(conv, nn.LeakyReLU(0.2)))
    return nn.ModuleList(stages)
