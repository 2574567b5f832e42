"""The GAN game and feature matching (paper Sec. 3.6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn import functional

from gsgan.errors import ConfigError

Maps = Sequence[Sequence[Tensor]]  # per scale: feature maps, the logits last


def _mean_over_scales(term: Callable[[Tensor], Tensor], maps: Maps) -> Tensor:
    return torch.stack([term(scale[-1].float()).mean() for scale in maps]).sum()


# name: (on real logits, on fake logits, generator's on fake logits)
_FORMS: dict[str, tuple[Callable[[Tensor], Tensor], ...]] = {
    "logistic": (
        lambda x: functional.softplus(-x),
        functional.softplus,
        lambda x: functional.softplus(-x),
    ),
    "hinge": (lambda x: functional.relu(1 - x), lambda x: functional.relu(1 + x), lambda x: -x),
    "lsgan": (lambda x: (x - 1).square(), lambda x: x.square(), lambda x: (x - 1).square()),
}


FORMS = tuple(_FORMS)


def _form(name: str) -> tuple[Callable[[Tensor], Tensor], ...]:
    if name not in _FORMS:
        raise ConfigError(f"training.step_two.gan must be one of {', '.join(_FORMS)}; got {name!r}")
    return _FORMS[name]


def discriminator_loss(real: Maps, fake: Maps, form: str = "logistic") -> Tensor:
    """What the discriminator minimises: mean over positions, sum over scales.

    Args:
        real, fake: the discriminator's maps of a real and a painted picture.
        form: ``logistic`` (non-saturating), ``hinge`` or ``lsgan``.
    """
    on_real, on_fake, _ = _form(form)
    return _mean_over_scales(on_real, real) + _mean_over_scales(on_fake, fake)


def generator_loss(fake: Maps, form: str = "logistic") -> Tensor:
    """What the generator minimises, same conventions."""
    return _mean_over_scales(_form(form)[2], fake)


def feature_matching(real: Maps, fake: Maps) -> Tensor:
    """L_feat: L1 between the judges' features (logits left out), real ones detached.

    Weighted as pix2pixHD: 4 / (number of maps) for each map, mean over scales.

    Source: paper Sec. 3.6; method.md § 7.
    """
    loss = real[0][0].new_zeros(())
    for real_scale, fake_scale in zip(real, fake, strict=True):
        weight = 4 / ((len(real_scale) - 1) * len(real))
        for a, b in zip(real_scale[:-1], fake_scale[:-1], strict=True):
            loss = loss + weight * functional.l1_loss(b, a.detach())
    return loss
