"""Hard losses and scores: equal and flat images, saturated discriminators, absent classes."""

from collections.abc import Iterator
from functools import lru_cache, partial

import torch
from torch import Tensor

from gsgan.losses.adversarial import (
    FORMS,
    discriminator_loss,
    feature_matching,
    generator_loss,
)
from gsgan.losses.perceptual import Perceptual
from gsgan.losses.photometric import d_ssim, photometric
from gsgan.metrics.image import psnr, ssim
from gsgan.model.discriminator import Discriminator
from gsgan.model.segmentation import IGNORE, segmentation_loss
from stability.cases.case import Case, Inputs, Outputs, Tolerance

SIDE = 24  # pixels

_case = partial(Case, "losses")


def _random(seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(
        1, 3, SIDE, SIDE, generator=generator, dtype=torch.float64
    )


def _flat(value: float) -> Tensor:
    return torch.full((1, 3, SIDE, SIDE), value, dtype=torch.float64)


PAIRS = {
    "ordinary images": (_random(0), _random(1)),
    "equal images": (_random(), _random()),
    "equal images but for 1e-4": (_random(), _random() + 1e-4),
    "opposite images": (_random(), 1 - _random()),
    "all background": (_flat(0), _flat(0)),
    "all background painted over": (_random(), _flat(0)),
    "a person left out": (_flat(0), _random()),
    "equal grey": (_flat(0.7), _flat(0.7)),
    "white and white": (_flat(1), _flat(1)),
    "two greys": (_flat(0.7), _flat(0.4)),
    "nearly flat images": (
        0.9 + 1e-3 * _random(),
        0.9 + 1e-3 * _random().flip(-1),
    ),
}
"""Pairs of images in [0, 1] by name."""

NOTES = {
    "equal images": "SSIM is 1, its slope 0.",
    "opposite images": "SSIM is near -1.",
    "equal grey": "A variance as E[x²] - E[x]² cancels here, and in float32 can be negative.",
    "nearly flat images": "Skin and cloth: the usual form's float32 gradient is 20 % off here.",
}


def cases() -> Iterator[Case]:
    """All of them."""
    for name, (image, target) in PAIRS.items():
        pair = partial(dict, image=image, target=target)
        for what, run in (
            ("D-SSIM", lambda x: {"D-SSIM": d_ssim(**x)}),
            (
                "L1, L2 and D-SSIM",
                lambda x: {"loss": photometric(**x, l1=0.8, l2=1.0, ssim=0.2)},
            ),
        ):
            title, note = f"{what} of {name}", NOTES.get(name, "")
            yield _case(
                title, pair, run, tolerance=Tolerance(1e-6, 5e-4), note=note
            )
        note = "PSNR is infinite: reported as such, counted, and kept out of means."
        note = note if torch.equal(image, target) else ""
        yield _case(f"PSNR and SSIM of {name}", pair, _scores, note=note)
        if name not in (
            "ordinary images",
            "equal images",
            "all background",
            "two greys",
        ):
            continue
        for what, run in (
            ("perceptual loss", _perceptual),
            (
                "discriminator's losses",
                partial(_adversarial, norm="instance", form="logistic"),
            ),
            (
                "comparing discriminator's",
                partial(_adversarial, norm="none", form="relativistic"),
            ),
        ):
            yield _case(
                f"{what} of {name}", pair, run, tolerance=Tolerance(1e-5, 1e-3)
            )
    # Discriminators that are certain, of the truth and of its opposite.
    logits = torch.tensor(
        [[1e4, -1e4, 90.0, -90.0, 0.0, 1.0]], dtype=torch.float64
    )
    for form in FORMS:
        inputs = partial(dict, real=logits, fake=logits.flip(-1))
        yield _case(
            f"{form} GAN with logits of ± 1e4", inputs, partial(_gan, form=form)
        )
    for name, probability, label, note in (
        (
            "class of probability 0",
            0.0,
            1,
            "log(P + 1e-6): a slope of 1e6 leads out of zero.",
        ),
        ("class of probability 1e-30", 1e-30, 1, ""),
        ("class of probability 1", 0.0, 0, ""),
        ("no pixel with a label", 0.3, IGNORE, "The loss is 0, not 0 / 0."),
    ):
        S = torch.full((1, 3, 4, 4), probability, dtype=torch.float64)
        S[:, 0] = 1 - 2 * probability
        inputs = partial(dict, S=S, labels=torch.full((1, 4, 4), label))
        yield _case(
            f"segmentation loss, {name}", inputs, _segmentation, note=note
        )
    for name, alpha in (("nothing painted", 0.0), ("something painted", 0.3)):
        yield _case(f"empty mask, {name}", partial(_empty, alpha), _step_one)


def _segmentation(inputs: Inputs) -> Outputs:
    return {"loss": segmentation_loss(inputs["S"], inputs["labels"])}


def _scores(inputs: Inputs) -> Outputs:
    with torch.no_grad():
        pair = inputs["image"].clamp(0, 1), inputs["target"].clamp(0, 1)
        return {"PSNR": psnr(*pair), "SSIM": ssim(*pair)}


@lru_cache(maxsize=8)
def _perceptual_loss(dtype: torch.dtype, device: torch.device) -> Perceptual:
    return Perceptual("random").eval().to(device, dtype)


@lru_cache(maxsize=8)
def _discriminator(
    dtype: torch.dtype, device: torch.device, norm: str
) -> Discriminator:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        made = Discriminator(scales=2, base=4, layers=3, norm=norm)
    return made.to(device, dtype)


def _perceptual(inputs: Inputs) -> Outputs:
    image, target = inputs["image"], inputs["target"]
    return {
        "L_perc": _perceptual_loss(image.dtype, image.device)(image, target)
    }


def _adversarial(inputs: Inputs, norm: str, form: str) -> Outputs:
    image, target = inputs["image"], inputs["target"]
    discriminator = _discriminator(image.dtype, image.device, norm)
    fake, real = discriminator(image), discriminator(target)
    return {
        "L_feat": feature_matching(real, fake),
        "L_GAN": generator_loss(real, fake, form),
        "discriminator's": discriminator_loss(real, fake, form),
    }


def _gan(inputs: Inputs, form: str) -> Outputs:
    real, fake = [[inputs["real"]]], [[inputs["fake"]]]
    return {
        "discriminator's": discriminator_loss(real, fake, form),
        "generator's": generator_loss(real, fake, form),
    }


def _empty(alpha: float) -> Inputs:
    """An image without a person, and what is painted there."""
    return {
        "image": _flat(0),
        "mask": _flat(0)[:, :1],
        "colour": alpha * _random(),
        "alpha": torch.full((1, 1, SIDE, SIDE), alpha, dtype=torch.float64),
        "background": torch.tensor([0.2, 0.9, 0.5], dtype=torch.float64),
    }


def _step_one(inputs: Inputs) -> Outputs:
    """Step I's loss over a background."""
    background = inputs["background"].view(1, 3, 1, 1)
    behind = (1 - inputs["alpha"]) * background
    target = inputs["image"] + (1 - inputs["mask"]) * background
    return {"loss": photometric(inputs["colour"] + behind, target)}
