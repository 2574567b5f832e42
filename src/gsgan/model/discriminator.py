"""The multi-scale patch discriminator, whose features also serve L_feat (paper Sec. 3.5)."""

from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional

from gsgan.utils.checks import integer, one_of

LEAKY_SLOPE = 0.2


class PatchDiscriminator(nn.Module):
    """One scale: 4×4 convolutions to a map of logits.

    Args:
        base: channels of the first layer.
        layers: feature layers; all but the last halve the resolution.
        norm: ``instance`` or ``none``. Instance normalisation equalises the contrast of every
            channel, which hides how sharp the image is (docs/ablations.md).

    Source: pix2pixHD (Wang et al., 2018).
    """

    def __init__(
        self, base: int = 64, layers: int = 4, norm: str = "instance"
    ) -> None:
        super().__init__()
        integer("training.discriminator.layers", layers, 2)
        one_of("training.discriminator.norm", norm, ("instance", "none"))
        normal = norm == "instance"

        # Channels double from layer to layer, up to eight times the base.
        widths = [base * min(2**i, 8) for i in range(layers)]
        blocks: list[nn.Module] = []
        previous = 3

        # The last feature layer keeps the resolution; the first has no normalisation.
        for i, channels in enumerate(widths):
            stride = 2 if i < layers - 1 else 1
            conv = nn.Conv2d(
                previous,
                channels,
                4,
                stride=stride,
                padding=2 if stride == 1 else 1,
            )
            between: list[nn.Module] = (
                [nn.InstanceNorm2d(channels)] if normal and i > 0 else []
            )
            blocks.append(
                nn.Sequential(conv, *between, nn.LeakyReLU(LEAKY_SLOPE))
            )
            previous = channels

        # The last layer gives one logit per patch.
        self.blocks = nn.ModuleList(blocks)
        self.logits = nn.Conv2d(previous, 1, 4, padding=2)

        # The start of the weights depends on whether their outputs are normalised.
        for conv in (
            module for module in self.modules() if isinstance(module, nn.Conv2d)
        ):
            if normal:
                nn.init.normal_(conv.weight, 0.0, 0.02)
            # He et al. 2015: without normalisation the signal would vanish under 0.02
            else:
                nn.init.kaiming_normal_(
                    conv.weight, a=LEAKY_SLOPE, nonlinearity="leaky_relu"
                )
            nn.init.zeros_(conv.bias)  # type: ignore[arg-type]

    def forward(self, image: Tensor) -> list[Tensor]:
        """Feature maps, then the logits, of an image ``[B, 3, H, W]``."""
        # Each block reads the map before it; the image itself is not a feature.
        maps = [image]
        for block in self.blocks:
            maps.append(block(maps[-1]))
        return [*maps[1:], self.logits(maps[-1])]


class Discriminator(nn.Module):
    """Patch discriminators at several scales, unconditional (they see the image only).

    Args:
        scales: number of discriminators; each sees the image at half the previous resolution.
        base, layers, norm: as `PatchDiscriminator`.

    Source: paper Sec. 3.5; scales, widths and normalisation are pix2pixHD's.
    """

    def __init__(
        self,
        *,
        scales: int = 2,
        base: int = 64,
        layers: int = 4,
        norm: str = "instance",
    ) -> None:
        super().__init__()
        # the name is kept for checkpoints
        self.judges = nn.ModuleList(
            PatchDiscriminator(base, layers, norm) for _ in range(scales)
        )
        self.stride = 2 ** (layers - 1 + scales - 1)

    def forward(self, image: Tensor) -> list[list[Tensor]]:
        """For each scale its feature maps with the logits last.

        Raises:
            ValueError: when the coarsest map could have a single pixel. Instance normalisation
                would erase it; without normalisation the same images are refused.
        """
        # The coarsest map must have more than one pixel.
        if min(image.shape[-2:]) < 2 * self.stride:
            raise ValueError(
                f"Discriminator: an image of {tuple(image.shape[-2:])} is too small; give at least "
                f"{2 * self.stride} pixels, or fewer scales or layers"
            )

        # Each discriminator sees the image at half the resolution of the one before.
        results = []
        for patches in self.judges:
            results.append(patches(image))
            image = functional.avg_pool2d(
                image, 3, stride=2, padding=1, count_include_pad=False
            )
        return results


@dataclass(frozen=True)
class DiscriminatorSettings:
    """Settings of `Discriminator`: the key ``training.discriminator``."""

    scales: int
    base: int
    layers: int
    norm: str

    def build(self) -> Discriminator:
        """The discriminator, with new weights."""
        return Discriminator(**vars(self))
