"""The losses of Step I and Step II: weights and weighted sums (paper Sec. 3.5, Alg. 2)."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from gsgan.losses.adversarial import (
    COMPARING,
    FORMS,
    discriminator_loss,
    feature_matching,
    generator_loss,
)
from gsgan.losses.perceptual import Perceptual, crop_person
from gsgan.losses.photometric import photometric, without_ignored
from gsgan.model.discriminator import Discriminator
from gsgan.model.rendering import Rendering
from gsgan.scene import Frame
from gsgan.utils.checks import at_least, between, integer, one_of
from gsgan.utils.tensors import full_precision


@dataclass(frozen=True)
class StepOneLoss:
    """L_Ψ = l1 · L1(C, I) + ssim · (1 - SSIM(C, I)), over a random colour or black.

    Args:
        l1, ssim: weights (paper: 0.8, 0.2).
        feature_head, alpha, perceptual: weights, see conf/training/_base.yaml; 0 builds no readout
            of F, and no perceptual network for Step I.
        perceptual_from: share of Step I without the perceptual loss.

    Source: paper Sec. 3.5 (λ = 0.2), without readout, alpha and the perceptual loss.
    """

    l1: float
    ssim: float
    feature_head: float
    alpha: float
    perceptual: float
    perceptual_from: float

    def __post_init__(self) -> None:
        at_least("training.step_one.perceptual", self.perceptual, 0)
        between("training.step_one.perceptual_from", self.perceptual_from, 0, 1)

    def __call__(
        self,
        rendering: Rendering,
        frame: Frame,
        background: Tensor | None,
        head: nn.Conv2d | None,
    ) -> Tensor:
        """The loss of a rendering of ``frame`` over ``background [B, 3, 1, 1]``, None for black;
        ``head`` is the linear readout of F. In full precision, autocast or not."""
        with full_precision(frame.image.device):
            assert rendering.features is not None
            assert rendering.splat_alpha is not None
            assert rendering.colour is not None

            # Ground truth and rendering are both put on the random background.
            target = frame.image
            behind = frame.image.new_zeros(())
            if background is not None:
                target = frame.image + (1 - frame.mask) * background
                behind = (1 - rendering.splat_alpha) * background

            # Step I's colour.
            pixels = {"l1": self.l1, "ssim": self.ssim}
            loss = photometric(
                rendering.colour + behind,
                target,
                ignored=frame.ignored,
                **pixels,
            )
            if head is not None:
                assert head.bias is not None
                # The bias is weighted by alpha, so that the readout commutes with blending. One
                # product, because a convolution with few channels is slower on a CPU.
                seen = torch.cat(
                    [rendering.features, rendering.splat_alpha], dim=1
                )
                weight = torch.cat(
                    [head.weight.flatten(1), head.bias[:, None]], dim=1
                )
                read = (weight @ seen.flatten(2)).unflatten(2, seen.shape[2:])
                loss = loss + self.feature_head * photometric(
                    read + behind, target, ignored=frame.ignored, **pixels
                )

            # Alpha has the mask as its target where no background supervises it.
            if background is None and self.alpha:
                matte = photometric(
                    rendering.splat_alpha,
                    frame.mask,
                    l1=1.0,
                    ssim=0.0,
                    ignored=frame.ignored,
                )
                loss = loss + self.alpha * matte
            return loss


def perceptual_distance(
    perceptual: Perceptual, image: Tensor, frame: Frame, draws: Tensor | None
) -> Tensor:
    """L_perc of an image ``[B, 3, H, W]`` of a frame, or of crops that ``draws`` place."""
    # Unsure pixels of the target show the image itself.
    target = without_ignored(frame.image, image, frame.ignored)
    compared = [image, target]

    # Slow networks compare squares of the person alone.
    if perceptual.crop is not None:
        assert draws is not None
        compared = crop_person(compared, frame.mask, draws, perceptual.crop)
    return perceptual(*compared)  # type: ignore[no-any-return]


def discriminate(
    discriminator: Discriminator, image: Tensor, gan: str
) -> list[list[Tensor]]:
    """The discriminator's maps of an image; in full precision where the GAN's form compares two
    images, since bf16 rounds away small differences."""
    # Other forms judge each image on its own and bear autocast.
    if gan not in COMPARING:
        return discriminator(image)  # type: ignore[no-any-return]
    with full_precision(image.device):
        dtype = next(discriminator.parameters()).dtype
        return discriminator(image.to(dtype))  # type: ignore[no-any-return]


class DiscriminatorMaps:
    """The discriminator's maps of a frame and of its rendering, computed once for the generator's
    loss and for the discriminator's.

    Args:
        discriminator: its parameters get no gradient through the generator's terms.
        image, target: ``[B, 3, H, W]`` I_pred and the ground truth.
        gan: see `discriminate`.
    """

    def __init__(
        self,
        discriminator: Discriminator,
        image: Tensor,
        target: Tensor,
        gan: str,
    ) -> None:
        self.image = image
        self.gan = gan
        # a leaf, so that neither loss reaches the other's parameters
        self.copy = image.detach().requires_grad_(image.requires_grad)

        # Both images are judged, the rendering through its copy.
        with torch.enable_grad():
            self.fake = discriminate(discriminator, self.copy, gan)
            self.real = discriminate(discriminator, target.detach(), gan)

    def terms(self, adversarial: float, matching: float) -> dict[str, Tensor]:
        """The generator's terms by name, weighted; a term of weight 0 is left out."""
        # The terms of the copy would also give the discriminator's parameters a gradient.
        terms = {}
        if adversarial:
            terms["adversarial"] = adversarial * generator_loss(
                self.real, self.fake, self.gan
            )
        if matching:
            terms["feature_matching"] = matching * feature_matching(
                self.real, self.fake
            )

        # Through this function the image gets its gradient, and the parameters get none.
        weighted = _Through.apply(self.image, (self.copy, list(terms.values())))
        return dict(zip(terms, weighted, strict=True))

    @property
    def difference(self) -> Tensor:
        """``[scales]`` mean absolute differences of the logits of both images."""
        # The last map of each scale has the logits.
        pairs = zip(self.fake, self.real, strict=True)
        return torch.stack(
            [(a[-1] - b[-1]).detach().abs().mean() for a, b in pairs]
        )

    def loss(self) -> Tensor:
        """The discriminator's loss."""
        return discriminator_loss(self.real, self.fake, self.gan)


class _Through(torch.autograd.Function):
    """Terms of a copy of an image as terms of the image; parameters on the way get no gradient."""

    @staticmethod
    def forward(
        ctx: Any, image: Tensor, path: tuple[Tensor, list[Tensor]]
    ) -> tuple[Tensor, ...]:
        # in a tuple, which hides them from autograd: it would follow them as well
        ctx.copy, ctx.terms = path
        terms = ctx.terms
        return tuple(term.detach().clone() for term in terms)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        # The gradient is of the copy alone. The graph is kept for the discriminator's loss.
        (grad,) = torch.autograd.grad(
            ctx.terms, ctx.copy, grads, retain_graph=True
        )
        return grad, None


@dataclass(frozen=True)
class StepTwoLoss:
    """Weights of the generator's loss (conf/training/_base.yaml); 0 computes no term.

    Source: paper Sec. 3.5 and Alg. 2, an unweighted sum of L_GAN, L_perc and L_feat.
    """

    # Terms of I_pred against the ground truth, by pixel.
    l1: float
    l2: float
    ssim: float
    alpha: float

    # Terms of networks: L_perc, L_GAN and L_feat.
    perceptual: float
    perceptual_every: int
    adversarial: float
    feature_matching: float
    gan: str

    # The term of Step I's colour, L_Ψ.
    anchor: float

    def __post_init__(self) -> None:
        one_of("training.step_two.gan", self.gan, FORMS)
        integer("training.step_two.perceptual_every", self.perceptual_every, 1)

    def discriminator_maps(
        self, discriminator: Discriminator, rendering: Rendering, frame: Frame
    ) -> DiscriminatorMaps:
        """The discriminator's maps of a rendering of ``frame``."""
        # Unsure pixels show the image itself in the target.
        assert rendering.image is not None
        target = without_ignored(frame.image, rendering.image, frame.ignored)
        return DiscriminatorMaps(
            discriminator, rendering.image, target, self.gan
        )

    @property
    def adversarial_terms(self) -> bool:
        """Whether any term needs the discriminator."""
        return bool(self.adversarial or self.feature_matching)

    def terms(
        self,
        rendering: Rendering,
        frame: Frame,
        *,
        anchor: Tensor | None,
        perceptual: Perceptual | None,
        draws: Tensor | None,
        maps: DiscriminatorMaps | None,
        step: int,
    ) -> dict[str, Tensor]:
        """The generator's losses, weighted, by name.

        Args:
            rendering: I_pred and its alpha.
            frame: the ground truth.
            anchor: L_Ψ of the same rendering; None leaves it out.
            perceptual: L_perc; None leaves it out.
            draws: ``[B, N]`` uniform random numbers in [0, 1) that place its crops; None without.
            maps: the discriminator's maps; None before the GAN starts.
            step: the iteration, for ``perceptual_every``.
        """
        # I_pred on black.
        image = rendering.image
        alpha = rendering.alpha
        assert image is not None and alpha is not None  # noqa: PT018
        target = without_ignored(frame.image, image, frame.ignored)
        by_pixel = partial(photometric, l1=self.l1, l2=self.l2, ssim=self.ssim)
        terms = {"photometric": by_pixel(image, target)}

        # The same on white, which supervises the alpha.
        if self.alpha:
            white = image + 1 - alpha
            truth = frame.image + 1 - frame.mask
            terms["alpha"] = self.alpha * by_pixel(
                white, truth, ignored=frame.ignored
            )

        # L_Ψ and L_perc, which is weighted as much more as it is computed less often.
        if anchor is not None:
            terms["anchor"] = self.anchor * anchor
        if perceptual is not None and step % self.perceptual_every == 0:
            scale = self.perceptual * self.perceptual_every
            distance = perceptual_distance(perceptual, image, frame, draws)
            terms["perceptual"] = scale * distance

        # The terms of the GAN, once it trains.
        if maps is not None:
            terms |= maps.terms(self.adversarial, self.feature_matching)
        return terms
