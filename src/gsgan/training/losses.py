"""What Step I and Step II minimise: weights, and the sums they weigh (paper Sec. 3.6, Alg. 2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from gsgan.errors import ConfigError
from gsgan.losses.adversarial import COMPARING, FORMS, feature_matching, generator_loss
from gsgan.losses.perceptual import Perceptual
from gsgan.losses.photometric import photometric, without_unsure
from gsgan.model.avatar import Painting
from gsgan.model.discriminator import Discriminator
from gsgan.precision import full_precision
from gsgan.scene import Frame


@dataclass(frozen=True)
class StepOneLoss:
    """L_Ψ = l1 · L1(C, I) + ssim · (1 - SSIM(C, I)), over a background.

    Args:
        l1, ssim: weights (paper: 0.8, 0.2).
        feature_head: weight of the same loss on a linear readout of F; without it F's further
            channels get no gradient in Step I. 0 builds no readout.

    Source: paper Sec. 3.6.
    """

    l1: float = 0.8
    ssim: float = 0.2
    feature_head: float = 0.5

    def __call__(
        self, painting: Painting, frame: Frame, background: Tensor, head: nn.Conv2d | None
    ) -> Tensor:
        """The loss of a painting of ``frame`` over ``background [B, 3, 1, 1]``; ``head`` is the
        linear readout of F. In full precision, autocast or not."""
        with full_precision(frame.image):
            return self._loss(painting, frame, background, head)

    def _loss(
        self, painting: Painting, frame: Frame, background: Tensor, head: nn.Conv2d | None
    ) -> Tensor:
        target = frame.image + (1 - frame.mask) * background
        assert painting.features is not None and painting.alpha is not None  # noqa: PT018
        assert painting.colour is not None
        behind = (1 - painting.alpha) * background
        pixels = {"l1": self.l1, "ssim": self.ssim}
        loss = photometric(painting.colour + behind, target, unsure=frame.unsure, **pixels)
        if head is not None:
            # No bias where nothing is: the readout commutes with alpha blending.
            read = functional.conv2d(painting.features, head.weight)
            read = read + painting.alpha * head.bias.view(1, 3, 1, 1)  # type: ignore[union-attr]
            loss = loss + self.feature_head * photometric(
                read + behind, target, unsure=frame.unsure, **pixels
            )
        return loss


def judged(judge: Discriminator, image: Tensor, gan: str) -> list[list[Tensor]]:
    """The discriminator's maps of a picture; in full precision where the GAN's form compares two,
    since bf16 rounds away what nearly equal pictures differ in."""
    if gan not in COMPARING:
        return judge(image)  # type: ignore[no-any-return]
    with full_precision(image):
        return judge(image.to(next(judge.parameters()).dtype))  # type: ignore[no-any-return]


@dataclass(frozen=True)
class StepTwoLoss:
    """Weights of the generator's loss; a term of weight 0 is not computed.

    Args:
        l1, l2, ssim: photometric terms on I_pred (the paper's footnote: l2 reconstruction).
        perceptual: L_perc.
        perceptual_every: compute L_perc only every so many iterations (its weight is multiplied
            by as much); VGG is the costliest term on a CPU.
        adversarial: L_GAN.
        feature_matching: L_feat, between the discriminator's features.
        gan: ``logistic``, ``hinge``, ``lsgan`` or ``relativistic``.
        anchor: weight of L_Ψ, which keeps C a picture while Ψ learns from the generator.
        detach_features: keep the generator's gradient out of Ψ (ablation).

    Source: paper Sec. 3.6.
    """

    l1: float = 1.0
    l2: float = 0.0
    ssim: float = 0.2
    perceptual: float = 1.0
    perceptual_every: int = 1
    adversarial: float = 1.0
    feature_matching: float = 10.0
    gan: str = "logistic"
    anchor: float = 1.0
    detach_features: bool = False

    def __post_init__(self) -> None:
        if self.gan not in FORMS:
            raise ConfigError(
                f"training.step_two.gan must be one of {', '.join(FORMS)}; got {self.gan!r}"
            )
        if self.perceptual_every < 1:
            raise ConfigError(
                "training.step_two.perceptual_every must be at least 1, "
                f"got {self.perceptual_every}"
            )

    @property
    def plays(self) -> bool:
        """Whether a discriminator is needed at all."""
        return bool(self.adversarial or self.feature_matching)

    def terms(
        self,
        image: Tensor,
        frame: Frame,
        *,
        anchor: Tensor | None,
        perceptual: Perceptual | None,
        judge: Discriminator | None,
        step: int,
    ) -> dict[str, Tensor]:
        """The generator's losses, weighted, by name.

        Args:
            image: ``[B, 3, H, W]`` I_pred.
            frame: what it should be.
            anchor: L_Ψ of the same painting; None leaves it out.
            perceptual: L_perc; None leaves it out.
            judge: the discriminator; None while it does not play.
            step: the iteration, for ``perceptual_every``.
        """
        target = without_unsure(frame.image, image, frame.unsure)
        pixels = photometric(image, target, l1=self.l1, l2=self.l2, ssim=self.ssim)
        terms = {"photometric": pixels}
        if anchor is not None:
            terms["anchor"] = self.anchor * anchor
        if perceptual is not None and step % self.perceptual_every == 0:
            scale = self.perceptual * self.perceptual_every
            terms["perceptual"] = scale * perceptual(image, target)
        if judge is not None:
            terms |= self._game(judge, image, target)
        return terms

    def _game(self, judge: Discriminator, image: Tensor, target: Tensor) -> dict[str, Tensor]:
        terms = {}
        real = fake = judged(judge, image, self.gan)
        if self.feature_matching or self.gan in COMPARING:
            with torch.no_grad():
                real = judged(judge, target, self.gan)
        if self.adversarial:
            terms["adversarial"] = self.adversarial * generator_loss(real, fake, self.gan)
        if self.feature_matching:
            terms["feature_matching"] = self.feature_matching * feature_matching(real, fake)
        return terms
