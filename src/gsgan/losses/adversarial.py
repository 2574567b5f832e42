"""Adversarial losses and feature matching (paper Sec. 3.5)."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import l1_loss, relu, softplus

# Feature maps by scale; the last one of each scale holds the logits.
Maps = Sequence[Sequence[Tensor]]
Term = Callable[[Tensor, Tensor], Tensor]


class Form(NamedTuple):
    """The losses of both players at one position, of the real and the fake logit."""

    discriminator: Term
    generator: Term


_FORMS = {
    "logistic": Form(
        discriminator=lambda real, fake: softplus(-real) + softplus(fake),
        generator=lambda real, fake: softplus(-fake),
    ),
    "hinge": Form(
        discriminator=lambda real, fake: relu(1 - real) + relu(1 + fake),
        generator=lambda real, fake: -fake,
    ),
    "lsgan": Form(
        discriminator=lambda real, fake: (real - 1).square() + fake.square(),
        generator=lambda real, fake: (fake - 1).square(),
    ),
    "relativistic": Form(
        discriminator=lambda real, fake: softplus(fake - real),
        generator=lambda real, fake: softplus(real - fake),
    ),
}
FORMS = tuple(_FORMS)
# Forms whose generator loss depends on the real image.
COMPARING = ("relativistic",)


def _over_scales(term: Term, real: Maps, fake: Maps) -> Tensor:
    """The sum over scales of a term's mean over positions, in float32."""
    # Positions of a scale count alike, and so do scales.
    losses = []
    for real_scale, fake_scale in zip(real, fake, strict=True):
        # Logits may come in half precision.
        loss = term(real_scale[-1].float(), fake_scale[-1].float())
        losses.append(loss.mean())
    return torch.stack(losses).sum()


def discriminator_loss(
    real: Maps, fake: Maps, form: str = "logistic"
) -> Tensor:
    """The discriminator's loss: mean over positions, sum over scales.

    Args:
        real, fake: the discriminator's maps of a real and a generated image.
        form: ``logistic`` (non-saturating), ``hinge``, ``lsgan`` or ``relativistic``: compares
            the logits of the pair at each position (the paired form, RpGAN, of
            Jolicoeur-Martineau 2019; here both show the same frame). What both share
            cancels, so use it if generated images are close to the ground truth.
    """
    return _over_scales(_FORMS[form].discriminator, real, fake)


def generator_loss(real: Maps, fake: Maps, form: str = "logistic") -> Tensor:
    """The generator's loss, with the arguments of `discriminator_loss`; only `COMPARING` forms use
    ``real``, for others pass ``fake`` twice."""
    return _over_scales(_FORMS[form].generator, real, fake)


def feature_matching(real: Maps, fake: Maps) -> Tensor:
    """L_feat: L1 between the discriminators' features (without logits), real ones detached.

    The weights are those of pix2pixHD: 4 / (number of maps) per map, mean over scales.

    Source: paper Sec. 3.5.
    """
    # Real features are a target: they get no gradient.
    loss = real[0][0].new_zeros(())
    for real_scale, fake_scale in zip(real, fake, strict=True):
        # The logits are not among the features.
        weight = 4 / ((len(real_scale) - 1) * len(real))
        features = zip(real_scale[:-1], fake_scale[:-1], strict=True)
        for truth, generated in features:
            distance = l1_loss(generated, truth.detach())
            loss = loss + weight * distance
    return loss
