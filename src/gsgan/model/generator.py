"""The generator: a UNet with two encoders, modulated by the pose (paper Sec. 3.5)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional

from gsgan.utils.checks import AUTO, one_of
from gsgan.utils.tensors import derive, full_precision

# inside the root: an all-zero pixel (empty background) stays zero
NORM_FLOOR = 1e-6
SLOPE = 0.2
MIDDLE_BLOCKS = 2  # convolutions at the coarsest level


class Encoder(nn.Module):
    """A pyramid: a stem, then stride-2 levels; returns every level, finest first.

    The stem is a 3×3 convolution. With ``patch`` > 1 it is one of patch × patch pixels with that
    stride, followed by a 3×3.
    """

    def __init__(
        self, inputs: int, channels: Sequence[int], patch: int = 1
    ) -> None:
        super().__init__()

        # The stem reads single pixels, or patches of them.
        first = channels[0]
        kernel = {"kernel_size": 3, "padding": 1}
        stem = kernel if patch == 1 else {"kernel_size": patch, "stride": patch}
        self.stem = nn.Conv2d(inputs, first, **stem)  # type: ignore[arg-type]
        self.after = nn.Conv2d(first, first, **kernel) if patch > 1 else None  # type: ignore[arg-type]

        # Each level halves the resolution, then refines what it has.
        self.down = nn.ModuleList(
            nn.Conv2d(a, b, 3, stride=2, padding=1)
            for a, b in pairwise(channels)
        )
        self.refine = nn.ModuleList(
            nn.Conv2d(c, c, 3, padding=1) for c in channels[1:]
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """``[B, inputs, H, W]`` to levels ``[B, channels[l], h / 2^l, w / 2^l]``, h = H / patch."""
        return self.levels(self.stem(x))

    def levels(self, stem: Tensor) -> list[Tensor]:
        """The features of every level from the stem's output, before its activation."""
        # The stem is activated; with patches a second convolution follows.
        levels = [_activate(stem)]
        if self.after is not None:
            levels = [_activate(self.after(levels[0]))]

        # Each level is computed from the one before it.
        for down, refine in zip(self.down, self.refine, strict=True):
            levels.append(_activate(refine(_activate(down(levels[-1])))))
        return levels


class StyleModulation(nn.Module):
    """Per-pixel normalisation, scale and shift from E_s's level and the pose code g, activation.

    Normalising over channels at each pixel (not over the image) keeps colours independent of how
    much of the image is background. Both maps start at zero: the style starts as the identity.
    """

    def __init__(
        self, channels: int, style_channels: int, pose_channels: int
    ) -> None:
        super().__init__()

        # Scale and shift of each channel, from the map and from the pose.
        self.from_map = nn.Conv2d(style_channels, 2 * channels, 1)
        self.from_pose = nn.Linear(pose_channels, 2 * channels)
        for layer in (self.from_map, self.from_pose):
            start_at_zero(layer)

    def forward(self, h: Tensor, style: Tensor, g: Tensor) -> Tensor:
        """``h`` ``[B, C, h, w]``, styled by ``style`` ``[B, Cs, h, w]`` and ``g`` ``[B, 35]`` and
        activated."""
        # channels last in memory: channels of a pixel are a row
        rows = h.permute(0, 2, 3, 1)

        # The pose gives each channel a scale and a shift.
        modulation = self.from_pose(g).unsqueeze(1)

        # The style map adds its own at each pixel; a 1×1 convolution is a matrix product.
        weight = self.from_map.weight.flatten(1).mT.expand(len(h), -1, -1)
        styles = style.permute(0, 2, 3, 1).flatten(1, 2)
        modulation = torch.baddbmm(
            modulation + self.from_map.bias, styles, weight
        )
        modulation = modulation.unflatten(1, rows.shape[1:3])

        # Scale and shift of every pixel's channels.
        gamma, beta = modulation.chunk(2, dim=-1)
        # In float32 at least: half precision loses squares above 256 and below 2e-4.
        wide = rows.to(torch.promote_types(h.dtype, torch.float32))
        unit = functional.rms_norm(wide, wide.shape[-1:], eps=NORM_FLOOR).to(
            h.dtype
        )
        return _activate(torch.addcmul(beta + unit, unit, gamma)).permute(
            0, 3, 1, 2
        )


class DecoderLevel(nn.Module):
    """Reduce, upsample, join the skip, then two styled convolutions."""

    def __init__(
        self, inputs: int, channels: int, style_channels: int, pose: int
    ) -> None:
        super().__init__()
        # at low resolution, where it is cheap
        self.reduce = nn.Conv2d(inputs, channels, 1)
        self.convs = nn.ModuleList(
            nn.Conv2d(c, channels, 3, padding=1)
            for c in (2 * channels, channels)
        )
        self.styles = nn.ModuleList(
            StyleModulation(channels, style_channels, pose) for _ in range(2)
        )

    def forward(
        self, h: Tensor, skip: Tensor, style: Tensor, g: Tensor
    ) -> Tensor:
        # The first convolution also joins the skip.
        first, second = self.convs
        h = self._join(self.reduce(h), skip, first.weight, first.bias)  # type: ignore[arg-type]
        h = self.styles[0](h, style, g)
        return self.styles[1](second(h), style, g)  # type: ignore[no-any-return]

    def _join(
        self, h: Tensor, skip: Tensor, weight: Tensor, bias: Tensor
    ) -> Tensor:
        """A 3×3 convolution of ``h``, upsampled to the nearest, and ``skip`` as further channels.

        Two of three pixels under a kernel on an upsampled image are equal, so a transposed
        convolution with the sums of their weights does the same with 4/9 of the arithmetic.
        """
        # The kernel has a part for the upsampled map, and one for the skip.
        C = h.shape[1]
        kernel = derive(
            self, "upper", lambda: upsampling_kernel(weight[:, :C]), weight
        )
        lower = derive(
            self, "lower", lambda: channels_last(weight[:, C:]), weight
        )

        # A convolution of joined channels is the sum of the convolutions of its
        # parts.
        joined = functional.conv2d(skip, lower, bias, padding=1)
        joined += functional.conv_transpose2d(h, kernel, stride=2, padding=1)
        return joined


class Refinement(nn.Module):
    """From pixels of patches to those of the image, with half of the channels."""

    def __init__(self, channels: int, patch: int) -> None:
        super().__init__()
        self.patch = patch
        self.channels = channels // 2
        self.spread = nn.Conv2d(
            channels, self.channels * patch**2, 3, padding=1
        )
        self.conv = nn.Conv2d(self.channels, self.channels, 3, padding=1)

    def forward(self, h: Tensor) -> Tensor:
        """``[B, C, h, w]`` to ``[B, C / 2, patch h, patch w]``."""
        fine = functional.pixel_shuffle(self.spread(h), self.patch)
        return _activate(self.conv(_activate(fine)))


class Channels(NamedTuple):
    """The inputs of a generator.

    Args:
        feature: channels of F, colour included.
        segmentation: channels of S; 0 leaves S out (``wo_seg``).
        skeleton: channels of p₂D; 0: it takes F's place (``image_to_image``).
        pose: length of g.
        supersample: F is rendered this many times larger each way.
        dense: Gaussians on the body are as many as pixels, which a last level would not sharpen.
    """

    feature: int
    segmentation: int
    skeleton: int
    pose: int
    supersample: int
    dense: bool


class ImageGenerator(Protocol):
    """What an avatar needs of a generator: a module that paints an image and its alpha.

    Args:
        feature_bound: F's Gaussians are clamped to this range; None: they are not.
    """

    feature_bound: float | None

    def __call__(
        self,
        F: Tensor,
        S: Tensor | None,
        p2d: Tensor | None,
        g: Tensor,
        fine: Tensor | None = None,
        alpha: Tensor | None = None,
    ) -> Tensor:
        """``[B, 4, H, W]``: see `Generator.forward`."""

    def parameters(self) -> Iterator[nn.Parameter]:
        """The weights, as of every module."""


class GeneratorFactory(Protocol):
    """The config group ``model/generator``, which builds a generator."""

    def build(self, channels: Channels) -> ImageGenerator:
        """The generator of a scene's maps."""


class Generator(nn.Module):
    """F ⊕ S ⊕ p₂D and g to the image and its alpha.

    Args:
        feature_channels: channels of F, colour included.
        segmentation_channels: channels of S; 0 leaves S out (``wo_seg``).
        skeleton_channels: channels of p₂D.
        pose_channels: length of g.
        supersample: F is rendered this many times larger each way; its pixels enter E_c as channels
            beside their average; 1 for none.
        base: channels at full resolution.
        multipliers: channels of each level in units of ``base``; each level halves the resolution.
        patch: a power of 2: one pixel of the finest level covers patch × patch pixels, which are
            its channels. The first levels of ``multipliers`` are then left out.
        refine: with a patch, a last level of convolutions at the image's resolution.
        feature_bound: of the Gaussians' features, which `Avatar` clamps: that is cheaper than
            clamping images of them.

    The other settings are explained in conf/model/full.yaml. With ``rgb_skip`` the last layer
    starts at zero, so training starts at Step I's image. The output is not clamped, so that it can
    recover from black.

    Source: paper Sec. 3.5; sizes, style, the linear output and alpha are ours.
    """

    def __init__(
        self,
        feature_channels: int,
        segmentation_channels: int,
        skeleton_channels: int,
        pose_channels: int,
        supersample: int = 1,
        *,
        base: int = 32,
        multipliers: Sequence[int] = (1, 2, 4, 8, 8),
        patch: int = 1,
        refine: bool = False,
        style_share: float = 0.5,
        rgb_skip: bool = False,
        feature_bound: float = 1e3,
    ) -> None:
        super().__init__()
        one_of(
            "model.generator.patch",
            patch,
            [2**i for i in range(len(multipliers))],
        )

        # The whole network halves the resolution this often; images are padded to a multiple of
        # it.
        self.patch = patch
        self.stride = 2 ** (len(multipliers) - 1)

        # A patch takes the place of the first levels, so their channels are left out.
        channels = [base * m for m in multipliers][patch.bit_length() - 1 :]
        widths = [max(1, round(style_share * c)) for c in channels]

        # E_c reads F, S, p₂D and F's fine pixels; E_s reads F alone.
        inputs = feature_channels + segmentation_channels + skeleton_channels
        self.supersample = supersample
        if supersample > 1:
            inputs += feature_channels * supersample**2
        self.rgb_skip = rgb_skip
        self.feature_bound: float | None = feature_bound
        self.content = Encoder(inputs, channels, patch)
        self.style = Encoder(feature_channels, widths, patch)

        # The coarsest level is styled too.
        self.mid = nn.ModuleList(
            nn.Conv2d(channels[-1], channels[-1], 3, padding=1)
            for _ in range(MIDDLE_BLOCKS)
        )
        self.mid_style = nn.ModuleList(
            StyleModulation(channels[-1], widths[-1], pose_channels)
            for _ in range(MIDDLE_BLOCKS)
        )

        # The decoder goes from coarse to fine.
        self.up = nn.ModuleList(
            DecoderLevel(channels[i + 1], channels[i], widths[i], pose_channels)
            for i in reversed(range(len(channels) - 1))
        )

        # The last layer paints RGB and alpha, without a refinement for every pixel of a patch.
        self.refinement = Refinement(channels[0], patch) if refine else None
        painted = 4 * patch**2
        width = channels[0]
        if self.refinement is not None:
            painted = 4
            width = self.refinement.channels
        self.paint = nn.Conv2d(width, painted, 3, padding=1)
        if rgb_skip:
            start_at_zero(self.paint)

    def forward(
        self,
        F: Tensor,
        S: Tensor | None,
        p2d: Tensor | None,
        g: Tensor,
        fine: Tensor | None = None,
        alpha: Tensor | None = None,
    ) -> Tensor:
        """I_pred on black and its alpha, ``[B, 4, H, W]``, not clamped.

        Args:
            F: ``[B, C, H, W]`` rendered features, the first three channels Step I's colour.
            S: ``[B, classes, H, W]`` part probabilities, or None when built without.
            p2d: ``[B, 8, H, W]`` the drawn skeleton; None when it is F (image_to_image).
            g: ``[B, 35]`` the pose code.
            fine: ``[B, C, kH, kW]``, F before it was averaged; given where built to supersample.
            alpha: ``[B, 1, H, W]`` of F; given where built with ``rgb_skip``.

        Raises:
            ValueError: when ``fine`` or alpha is missing, or ``fine`` is of another size.
        """
        # The fine image must be there where the stem reads it, and only there.
        height, width = F.shape[-2:]
        k = self.supersample
        given = None if fine is None else tuple(fine.shape[-2:])
        expected = None if k == 1 else (k * height, k * width)
        if given != expected:
            raise ValueError(
                f"Generator: fine must be {expected} pixels, got {given}"
            )

        # E_c and E_s give features at every level.
        features = self._pad(F)
        others = [x for x in (S, p2d) if x is not None]
        skips = self.content.levels(self._stem(features, others, fine))
        styles = self.style(features)

        # The coarsest level, then the decoder with the skips from coarse to fine.
        h = skips[-1]
        for conv, style in zip(self.mid, self.mid_style, strict=True):
            h = style(conv(h), styles[-1], g)
        for i, level in enumerate(self.up):
            h = level(h, skips[-2 - i], styles[-2 - i], g)
        if self.refinement is not None:
            h = self.refinement(h)
        with full_precision(h.device):  # bf16 would round the image to 8 bits
            painted = self.paint(h.to(self.paint.weight.dtype))

        # Without a refinement, pixels of a patch are its channels; the padding is cut off.
        if self.refinement is None:
            painted = functional.pixel_shuffle(painted, self.patch)
        painted = painted[..., :height, :width]

        # The painted image is a correction of Step I's colour and alpha.
        if self.rgb_skip:
            if alpha is None:
                raise ValueError(
                    "Generator: built with rgb_skip=True, so alpha must be given"
                )
            painted[:, :3] += F[:, :3]
            painted[:, 3:] += alpha
        return painted

    def _stem(
        self, features: Tensor, others: list[Tensor], fine: Tensor | None
    ) -> Tensor:
        """E_c's stem on F, S, p₂D and F's fine pixels, without joining their channels.

        A convolution of joined channels is the sum of the convolutions of its parts.
        """
        weight = self.content.stem.weight
        bias = self.content.stem.bias
        k = self.supersample
        C = features.shape[1]
        stride = self.patch
        padding = int(self.patch == 1)

        # The part for F; with fine pixels it has a stride and padding in these.
        if fine is None:
            kernel = derive(
                self, "F", lambda: channels_last(weight[:, :C]), weight
            )
            h = functional.conv2d(features, kernel, bias, stride, padding)
        else:
            kernel = derive(
                self, "fine", lambda: fine_kernel(weight, C, k), weight
            )
            fine = self._pad(fine, k)
            h = functional.conv2d(fine, kernel, bias, k * stride, k * padding)

        # The parts for S and p₂D.
        first = C
        for i, given in enumerate(others):
            part = weight[:, first : first + given.shape[1]]
            kernel = derive(
                self, f"part {i}", partial(channels_last, part), weight
            )
            h += functional.conv2d(
                self._pad(given), kernel, None, stride, padding
            )
            first += given.shape[1]
        return h

    def _pad(self, x: Tensor, times: int = 1) -> Tensor:
        """Zeros on the right and below, up to a multiple of the stride; channels last."""
        (height, width), stride = x.shape[-2:], times * self.stride
        if height % stride or width % stride:
            x = functional.pad(x, (0, -width % stride, 0, -height % stride))
        return channels_last(x)


@dataclass(frozen=True)
class GeneratorSettings:
    """Settings of `Generator`: conf/model/generator/unet.yaml."""

    base: int
    multipliers: Sequence[int]
    patch: int
    refine: bool | str
    style_share: float
    rgb_skip: bool
    feature_bound: float

    def build(self, channels: Channels) -> Generator:
        """The UNet of a scene's maps."""
        refine = not channels.dense if self.refine == AUTO else self.refine
        return Generator(
            feature_channels=channels.feature,
            segmentation_channels=channels.segmentation,
            skeleton_channels=channels.skeleton,
            pose_channels=channels.pose,
            supersample=channels.supersample,
            **(vars(self) | {"refine": refine}),
        )


def fine_kernel(weight: Tensor, C: int, k: int) -> Tensor:
    """``[O, C, n k, n k]``: the part of a stem's ``weight`` that reads F, as one kernel on F's fine
    pixels: its first C channels read their averages, its last C k² each single one."""
    # Weights of single fine pixels, as a kernel over the fine grid.
    fine = (
        weight[:, -C * k * k :]
        .unflatten(1, (C, k, k))
        .permute(0, 1, 4, 2, 5, 3)
    )

    # Weights of the averages, spread over the k² fine pixels of each.
    mean = weight[:, :C, :, None, :, None] / (k * k)
    return channels_last((fine + mean).flatten(4, 5).flatten(2, 3))


def upsampling_kernel(weight: Tensor) -> Tensor:
    """``[I, O, 4, 4]`` of a transposed convolution of stride 2 and padding 1: the kernel
    ``[O, I, 3, 3]`` after upsampling to the nearest."""
    for dim in (2, 3):
        # A pixel reaches four upsampled ones in each direction, with these sums of weights.
        first, middle, last = weight.unbind(dim)
        weight = torch.stack([last, middle + last, first + middle, first], dim)
    return channels_last(weight.transpose(0, 1))


def channels_last(x: Tensor) -> Tensor:
    """The tensor with channels last in memory."""
    return x.contiguous(memory_format=torch.channels_last)


def start_at_zero(layer: nn.Module) -> None:
    """Sets weight and bias to 0: the layer adds nothing at first."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)


def _activate(x: Tensor) -> Tensor:
    return functional.leaky_relu(x, SLOPE, inplace=True)  # of new tensors only
