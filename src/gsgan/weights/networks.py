"""Pretrained networks as feature extractors, and LPIPS."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import convert_conv2d_weight_memory_format

from gsgan.utils.errors import DataError
from gsgan.weights.files import (
    NETWORKS,
    empty_layers,
    get,
    read_convolutions,
    state_of_heads,
)
from gsgan.weights.parts import BackgroundMaps

# The mean and deviation of ImageNet's channels, with which both networks were trained.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
# Layers of torchvision's `features` after which LPIPS compares: every ReLU before a pooling
# (VGG-16: relu1_2, relu2_2, relu3_3, relu4_3, relu5_3), and every ReLU (AlexNet).
TAPS = {"vgg": (3, 8, 15, 22, 29), "alex": (1, 4, 7, 9, 11)}
# Added to the squared norm of features, as in torchmetrics: the gradient is finite at zero.
EPSILON = 1e-8
# Sides of the smallest image: AlexNet's last map is empty for smaller ones.
MIN_PIXELS = 32


class FeatureNetwork(nn.Module):
    """Feature maps of a network with frozen weights, one map after each stage.

    Images are ``[B, 3, H, W]``, RGB in [0, 1]; they are normalised as ImageNet's.

    Args:
        stages: applied in turn, each to the map of the one before.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, stages: nn.ModuleList) -> None:
        super().__init__()
        self.stages = stages.requires_grad_(False)
        self.register_buffer(
            "mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1)
        )
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1))

    def forward(self, image: Tensor) -> list[Tensor]:
        """The maps ``[B, C, h, w]``, from the finest to the coarsest."""
        # Each stage continues from the map of the one before.
        maps = []
        features = self.normalise(image)
        for stage in self.stages:
            features = stage(features)
            maps.append(features)
        return maps

    def normalise(self, image: Tensor) -> Tensor:
        """Images with the mean and the deviation that the network was trained with."""
        return (image - self.mean) / self.std


def load_pretrained(net: str, path: str | Path | None = None) -> FeatureNetwork:
    """A pretrained network with the five stages that LPIPS compares.

    Args:
        net: ``vgg`` or ``alex``.
        path: see `gsgan.weights.files.find`.

    Raises:
        ConfigError: on an unknown network.
        DataError: if the weights are not found and cannot be downloaded, or belong to another
            network.
    """
    # Weights are assigned to layers without values, so nothing is drawn at random.
    weights = get(net, path)
    network = NETWORKS[net]
    layers = empty_layers(network)
    try:
        layers.load_state_dict(
            read_convolutions(net, weights.path), assign=True
        )
    # AttributeError: a value is no tensor
    except (RuntimeError, AttributeError) as error:
        raise DataError(
            f"{weights.path}: these are not torchvision's weights of {network.title}"
        ) from error

    # Layers must not overwrite the maps before them, which are kept.
    for layer in layers:
        if isinstance(layer, nn.ReLU):
            layer.inplace = False

    # A stage ends with the layer whose map LPIPS compares.
    stages = nn.ModuleList()
    start = 0
    for tap in TAPS[net]:
        stages.append(layers[start : tap + 1])
        start = tap + 1

    # A processor convolves and pools fastest where a pixel's channels lie together.
    convert_conv2d_weight_memory_format(stages, torch.channels_last)
    return FeatureNetwork(stages)


def unit(features: Tensor) -> Tensor:
    """Features ``[B, C, h, w]`` divided by their norm over the channels."""
    norm = (features.square().sum(dim=1, keepdim=True) + EPSILON).sqrt()
    return features / norm


def mean_distance(layers: Sequence[Tensor]) -> Tensor:
    """The distance ``[B]`` of two images, given its map in each layer."""
    means = [layer.mean(dim=(1, 2, 3)) for layer in layers]
    return torch.stack(means).sum(dim=0)


class Lpips(nn.Module):
    """LPIPS 0.1: the distance of unit-length features, weighted by channel.

    The distance of two images is the sum over the layers l of
    mean over pixels of ``Σ_c w_lc (â_lc - b̂_lc)²``, where â and b̂ are the features divided by their
    norm over the channels.

    Args:
        net: ``vgg`` or ``alex``.
        path: see `gsgan.weights.files.find`.

    Raises:
        ConfigError: on an unknown network.
        DataError: if there are no usable weights.

    Source: Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric,
    CVPR 2018; the heads of its package, version 0.1.
    """

    def __init__(self, net: str, path: str | Path | None = None) -> None:
        super().__init__()
        # One head per layer: the weights of its channels.
        self.network = load_pretrained(net, path)
        state = state_of_heads(net)
        for layer in range(len(TAPS[net])):
            self.register_buffer(
                f"head{layer}", state[f"lin{layer}.model.1.weight"]
            )
        self._background: BackgroundMaps | None = None

    def features(self, image: Tensor) -> list[Tensor]:
        """Unit-length features of images ``[B, 3, H, W]`` in [0, 1]."""
        return list(map(unit, self.network(image)))

    def background(self, image: Tensor) -> BackgroundMaps:
        """The maps of a normalised image ``[1, 3, H, W]`` of the background alone, kept for later
        calls."""
        kept = self._background
        if (
            kept is None
            or kept.image.device != image.device
            or not torch.equal(kept.image, image)
        ):
            kept = self._background = BackgroundMaps(self.network.stages, image)
        return kept

    def layers(
        self, features: Sequence[Tensor], others: Sequence[Tensor]
    ) -> list[Tensor]:
        """The distance of two images in each layer, as maps ``[B, 1, h, w]``."""
        # A head is a convolution of 1 x 1: the weighted sum over channels.
        maps = []
        for layer, (ours, theirs) in enumerate(
            zip(features, others, strict=True)
        ):
            head = self.get_buffer(f"head{layer}")
            maps.append(functional.conv2d((ours - theirs).square(), head))
        return maps

    def distance(
        self, features: Sequence[Tensor], others: Sequence[Tensor]
    ) -> Tensor:
        """The distance ``[B]`` of two images, given their features."""
        return mean_distance(self.layers(features, others))

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        """The distance ``[B]`` of images ``[B, 3, H, W]`` in [0, 1]."""
        return self.distance(self.features(image), self.features(target))
