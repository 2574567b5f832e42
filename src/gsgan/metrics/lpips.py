"""LPIPS of images against one ground truth, by several pretrained networks."""

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.data.metric_variants import MetricVariants
from gsgan.metrics.image import person_box
from gsgan.metrics.regions import BACKGROUNDS, mask_crop, rectangle
from gsgan.utils.checks import one_of
from gsgan.utils.errors import ConfigError
from gsgan.weights.networks import MIN_PIXELS, Lpips, mean_distance, unit
from gsgan.weights.parts import union

LPIPS_NETS = ("vgg", "alex")
# The scores of an image by metric.
LpipsScores = Callable[[Tensor], dict[str, float]]


def build_lpips(
    nets: Sequence[str], path: str | None = None
) -> dict[str, Lpips]:
    """The networks of LPIPS, with weights that exist.

    Args:
        nets: any of ``vgg`` and ``alex``; none of them leaves LPIPS out.
        path: of the weights, see `gsgan.weights.files.find`; None looks everywhere, or downloads.

    Raises:
        ConfigError: on an unknown network.
        DataError: if weights are not found and cannot be downloaded, or cannot be used.
    """
    for net in nets:
        one_of("an entry of lpips.nets", net, LPIPS_NETS)

    # All names are checked before the first download.
    return {net: Lpips(net, path).eval() for net in nets}


class LpipsAgainst:
    """LPIPS against one ground truth, whose features are computed once for all images.

    Where both images show the background, their features are equal and the distance is 0, so
    features are computed of what else the images show, see `gsgan.weights.parts`.

    Args:
        target: ``[1, 3, H, W]``, prepared, in [0, 1].
        mask: ``[1, 1, H, W]`` of the person; None leaves the scores in the person's box out.
        networks: by name, from `build_lpips`.
        measures: range, channels and region; None takes the defaults.

    Raises:
        ConfigError: where there are networks, and the images are too small for them.
    """

    @torch.no_grad()
    def __init__(
        self,
        target: Tensor,
        mask: Tensor | None,
        networks: Mapping[str, Lpips],
        measures: MetricVariants | None = None,
    ) -> None:
        # Without measures, LPIPS is that of whole images in [0, 1].
        self.networks = networks
        self.measures = measures or MetricVariants()
        self.mask = mask
        self.box = None if mask is None else rectangle(person_box(mask)[0])
        height, width = target.shape[-2:]
        self.size = (height, width)
        if networks and min(height, width) < MIN_PIXELS:
            raise ConfigError(
                f"LPIPS needs images of at least {MIN_PIXELS} pixels each way, got "
                f"{width} × {height}; lpips.nets=[] leaves it out"
            )

        # The ground truth's features, of the whole image and of the square.
        behind = torch.full_like(target, BACKGROUNDS[self.measures.background])
        background = self._to_input(behind)
        whole = self._to_input(target)
        square = self._square(target)
        self.backgrounds = {}
        self.truth = {}
        self.square_truth = {}
        for net, network in networks.items():
            network.to(target.device)
            normalised = network.network.normalise
            self.backgrounds[net] = network.background(normalised(background))
            self.truth[net] = self.backgrounds[net].differing(normalised(whole))
            if square is not None:
                self.square_truth[net] = network.features(square)

    @torch.no_grad()
    def __call__(self, image: Tensor) -> dict[str, float]:
        """The scores of an image like the ground truth, NaN without a region.

        Returns:
            ``{"lpips_<net>": score, "lpips_<net>_person": score}``; the latter is the mean of the
            distance's map in the person's box, with receptive fields that reach beyond it.
        """
        whole = self._to_input(image)
        square = self._square(image)
        scores = {}
        for net, network in self.networks.items():
            layers = self._layers(net, whole)

            # The score of the region that the protocol asks for.
            if self.measures.lpips_region == "full":
                scores[f"lpips_{net}"] = float(mean_distance(layers))
            elif square is None:
                scores[f"lpips_{net}"] = math.nan
            else:
                image_features = network.features(square)
                distance = network.distance(
                    image_features, self.square_truth[net]
                )
                scores[f"lpips_{net}"] = float(distance)

            # The score in the person's box: the maps of the whole image, enlarged to its size.
            if self.mask is not None:
                inside = math.nan
                if self.box is not None:
                    rows, columns = self.box
                    distances = torch.zeros_like(image[:, :1])
                    for layer in layers:
                        distances += functional.interpolate(
                            layer, self.size, mode="bilinear"
                        )
                    inside = float(distances[:, :, rows, columns].mean())
                scores[f"lpips_{net}_person"] = inside
        return scores

    def _layers(self, net: str, image: Tensor) -> list[Tensor]:
        """The distance's map ``[1, 1, h, w]`` of each layer: 0 where both images show the
        background, and computed elsewhere."""
        background = self.backgrounds[net]
        truth = self.truth[net]
        predicted = background.differing(
            self.networks[net].network.normalise(image)
        )
        shown = list(filter(None, (predicted, truth)))
        if not shown:
            return [torch.zeros_like(x[:, :1]) for x in background.maps]

        # The features of both images where either differs from the background.
        features: list[Tensor] = []
        others: list[Tensor] = []
        padding = []
        for stage, whole in enumerate(background.maps):
            rows = union([parts[stage].rows for parts in shown])
            columns = union([parts[stage].columns for parts in shown])
            features.append(
                unit(background.on(stage, predicted, rows, columns))
            )
            others.append(unit(background.on(stage, truth, rows, columns)))

            # The rest of the map: left, right, above and below.
            height, width = whole.shape[-2:]
            sides = (columns[0], width - columns[1])
            padding.append((*sides, rows[0], height - rows[1]))

        # The maps, with zeros around.
        layers = self.networks[net].layers(features, others)
        return [
            functional.pad(layer, beyond)
            for layer, beyond in zip(layers, padding, strict=True)
        ]

    def _to_input(self, image: Tensor) -> Tensor:
        """The image with the protocol's channels and range, as the networks get it."""
        # Some published scores are of images whose channels were swapped.
        if self.measures.lpips_channels == "bgr":
            image = image.flip(1)
        # The network maps [0, 1] to [-1, 1]; an unscaled range reverses that.
        if self.measures.lpips_range == (0.0, 1.0):
            return (image + 1) / 2
        return image

    def _square(self, image: Tensor) -> Tensor | None:
        """The crop around the person as the networks get it; None if the region is the full image,
        or there is no person."""
        if self.measures.lpips_region == "full":
            return None
        assert self.mask is not None

        # The square is filled with the background.
        background = BACKGROUNDS[self.measures.background]
        square = mask_crop(image[0], self.mask[0], background)
        return None if square is None else self._to_input(square[None])
