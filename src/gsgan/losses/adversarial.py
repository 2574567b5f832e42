"""Adversarial losses and feature matching (paper Sec. 3.5)."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional

Maps = Sequence[Sequence[Tensor]]  # per scale: feature maps, the logits last
Term = Callable[[Tensor, Tensor], Tensor]
softplus = functional.softplus
relu = functional.relu

# name: (discriminator's loss, generator's loss) of (real, fake) logits
_FORMS: dict[str, tuple[Term, Term]] = {
    "logistic": (lambda r, f: softplus(-r) + softplus(f), lambda _, f: softplus(-f)),
    "hinge": (lambda r, f: relu(1 - r) + relu(1 + f), lambda _, f: -f),
    "lsgan": (
        lambda r, f: (r - 1).square() + f.square(),
        lambda _, f: (f - 1).square(),
    ),
    "relativistic": (lambda r, f: softplus(f - r), lambda r, f: softplus(r - f)),
}
FORMS = tuple(_FORMS)
COMPARING = ("relativistic",)  # forms whose generator loss depends on the real image


def _loss(form: str, which: int, real: Maps, fake: Maps) -> Tensor:
    term = _FORMS[form][which]
    scales = zip(real, fake, strict=True)
    return torch.stack(
        [term(r[-1].float(), f[-1].float()).mean() for r, f in scales]
    ).sum()


def discriminator_loss(real: Maps, fake: Maps, form: str = "logistic") -> Tensor:
    """The discriminator's loss: mean over positions, sum over scales.

    Args:
        real, fake: the discriminator's maps of a real and a generated image.
        form: ``logistic`` (non-saturating), ``hinge``, ``lsgan`` or ``relativistic``: compares
            the logits of the pair at each position (the paired form, RpGAN, of
            Jolicoeur-Martineau 2019; here both show the same frame). What both share
            cancels, so use it where generated images are close to the ground truth.
    """
    return _loss(form, 0, real, fake)


def generator_loss(real: Maps, fake: Maps, form: str = "logistic") -> Tensor:
    """The generator's loss, same conventions; only `COMPARING` forms use ``real``, for others pass
    ``fake`` twice."""
    return _loss(form, 1, real, fake)


def feature_matching(real: Maps, fake: Maps) -> Tensor:
    """L_feat: L1 between the discriminators' features (without logits), real ones detached.

    Weighted as in pix2pixHD: 4 / (number of maps) per map, mean over scales.

    Source: paper Sec. 3.5.
    """
    loss = real[0][0].new_zeros(())
    for real_scale, fake_scale in zip(real, fake, strict=True):
        weight = 4 / ((len(real_scale) - 1) * len(real))
        for a, b in zip(real_scale[:-1], fake_scale[:-1], strict=True):
            loss = loss + weight * functional.l1_loss(b, a.detach())
    return loss
