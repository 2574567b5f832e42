"""Hard losses and scores: equal and flat pictures, sure judges, classes that are not there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from gsgan.bench.cases.case import Case, Inputs, Outputs, Tolerance
from gsgan.bench.cases.poses import rounded
from gsgan.losses.adversarial import FORMS, discriminator_loss, feature_matching, generator_loss
from gsgan.losses.perceptual import Perceptual
from gsgan.losses.photometric import d_ssim, photometric
from gsgan.metrics.image import psnr, ssim
from gsgan.model.discriminator import Discriminator
from gsgan.model.segmentation import IGNORE, segmentation_loss

SUBJECT = "losses"
SIDE = 24
"""Pixels."""


def _random(seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(1, 3, SIDE, SIDE, generator=generator, dtype=torch.float64)


def _flat(value: float) -> Tensor:
    return torch.full((1, 3, SIDE, SIDE), value, dtype=torch.float64)


PAIRS: dict[str, tuple[Callable[[], tuple[Tensor, Tensor]], str]] = {
    "ordinary pictures": (lambda: (_random(0), _random(1)), ""),
    "equal pictures": (lambda: (_random(), _random()), "SSIM is 1, its slope 0."),
    "equal pictures but for 1e-4": (lambda: (_random(), _random() + 1e-4), ""),
    "opposite pictures": (lambda: (_random(), 1 - _random()), "SSIM is near -1."),
    "all background": (lambda: (_flat(0), _flat(0)), ""),
    "all background painted over": (lambda: (_random(), _flat(0)), ""),
    "a person left out": (lambda: (_flat(0), _random()), ""),
    "equal grey": (
        lambda: (_flat(0.7), _flat(0.7)),
        "A variance as E[x²] - E[x]² cancels here, and in float32 can be negative.",
    ),
    "white and white": (lambda: (_flat(1), _flat(1)), ""),
    "two greys": (lambda: (_flat(0.7), _flat(0.4)), ""),
    "nearly flat pictures": (
        lambda: (0.9 + 1e-3 * _random(), 0.9 + 1e-3 * _random().flip(-1)),
        "Skin and cloth: the usual form's float32 gradient is 20 % off here.",
    ),
}
"""Pairs of pictures in [0, 1] by name, and what to say of them."""


def _pair(name: str) -> Callable[[torch.dtype, torch.device], Inputs]:
    def make() -> Inputs:
        image, target = PAIRS[name][0]()
        return {"image": image, "target": target}

    return rounded(make)


def _d_ssim(inputs: Inputs) -> Outputs:
    return {"D-SSIM": d_ssim(inputs["image"], inputs["target"])}


def _photometric(inputs: Inputs) -> Outputs:
    return {"loss": photometric(inputs["image"], inputs["target"], l1=0.8, l2=1.0, ssim=0.2)}


def _scores(inputs: Inputs) -> Outputs:
    with torch.no_grad():
        pair = inputs["image"].clamp(0, 1), inputs["target"].clamp(0, 1)
        return {"PSNR": psnr(*pair), "SSIM": ssim(*pair)}


def _pictures() -> Iterator[Case]:
    for name, (_, note) in PAIRS.items():
        for what, run in (("D-SSIM", _d_ssim), ("L1, L2 and D-SSIM", _photometric)):
            yield Case(
                name=f"{what} of {name}",
                subject=SUBJECT,
                build=_pair(name),
                run=run,
                tolerance=Tolerance(1e-6, 5e-4),
                note=note,
            )
    for name in PAIRS:
        endless = name in ("equal pictures", "all background", "equal grey", "white and white")
        yield Case(
            name=f"PSNR and SSIM of {name}",
            subject=SUBJECT,
            build=_pair(name),
            run=_scores,
            note="PSNR is infinite: reported as such, counted, and kept out of means." * endless,
        )


@lru_cache(maxsize=8)
def _stand_in(dtype: torch.dtype, device: torch.device) -> Perceptual:
    return Perceptual("random").eval().to(device, dtype)


@lru_cache(maxsize=8)
def _judge(dtype: torch.dtype, device: torch.device, norm: str) -> Discriminator:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        judge = Discriminator(scales=2, base=4, layers=3, norm=norm)
    return judge.to(device, dtype)


def _perceptual(inputs: Inputs) -> Outputs:
    image, target = inputs["image"], inputs["target"]
    return {"L_perc": _stand_in(image.dtype, image.device)(image, target)}


def _features(inputs: Inputs, norm: str, form: str) -> Outputs:
    image, target = inputs["image"], inputs["target"]
    judge = _judge(image.dtype, image.device, norm)
    fake, real = judge(image), judge(target)
    return {
        "L_feat": feature_matching(real, fake),
        "L_GAN": generator_loss(real, fake, form),
        "judge's": discriminator_loss(real, fake, form),
    }


def _networks() -> Iterator[Case]:
    for name in ("ordinary pictures", "equal pictures", "all background", "two greys"):
        for what, run in (
            ("perceptual loss", _perceptual),
            ("discriminator's losses", partial(_features, norm="instance", form="logistic")),
            ("comparing discriminator's", partial(_features, norm="none", form="relativistic")),
        ):
            yield Case(
                name=f"{what} of {name}",
                subject=SUBJECT,
                build=_pair(name),
                run=run,
                tolerance=Tolerance(1e-5, 1e-3),
            )


def _gan(inputs: Inputs, form: str) -> Outputs:
    real, fake = [[inputs["real"]]], [[inputs["fake"]]]
    return {
        "judge's": discriminator_loss(real, fake, form),
        "generator's": generator_loss(real, fake, form),
    }


def _sure_judges() -> Iterator[Case]:
    """Judges that are sure, of the truth and of its opposite."""
    logits = torch.tensor([[1e4, -1e4, 90.0, -90.0, 0.0, 1.0]], dtype=torch.float64)
    for form in FORMS:
        yield Case(
            name=f"{form} GAN with logits of ± 1e4",
            subject=SUBJECT,
            build=rounded(lambda: {"real": logits, "fake": logits.flip(-1)}),
            run=partial(_gan, form=form),
        )


def _classes(inputs: Inputs) -> Outputs:
    return {"loss": segmentation_loss(inputs["S"], inputs["labels"])}


def _segmentation() -> Iterator[Case]:
    def maps(probability: float, label: int) -> Inputs:
        S = torch.full((1, 3, 4, 4), probability, dtype=torch.float64)
        S[:, 0] = 1 - 2 * probability
        return {"S": S, "labels": torch.full((1, 4, 4), label)}

    hard: tuple[tuple[str, float, int, str], ...] = (
        ("class of probability 0", 0.0, 1, "log(P + 1e-6): a slope of 1e6 leads out of zero."),
        ("class of probability 1e-30", 1e-30, 1, ""),
        ("class of probability 1", 0.0, 0, ""),
        ("no pixel with a label", 0.3, IGNORE, "The loss is 0, not 0 / 0."),
    )
    for name, probability, label, note in hard:
        yield Case(
            name=f"segmentation loss, {name}",
            subject=SUBJECT,
            build=rounded(lambda p=probability, k=label: maps(p, k)),  # type: ignore[misc]
            run=_classes,
            note=note,
        )


def _empty_mask(inputs: Inputs) -> Outputs:
    """Step I's loss on a frame without a person, over a background."""
    background = inputs["background"].view(1, 3, 1, 1)
    behind = (1 - inputs["alpha"]) * background
    target = inputs["image"] + (1 - inputs["mask"]) * background
    return {"loss": photometric(inputs["colour"] + behind, target)}


def _masks() -> Iterator[Case]:
    shared: dict[str, Any] = {"subject": SUBJECT, "run": _empty_mask}

    def frame(alpha: float) -> Inputs:
        return {
            "image": _flat(0),
            "mask": _flat(0)[:, :1],
            "colour": alpha * _random(),
            "alpha": torch.full((1, 1, SIDE, SIDE), alpha, dtype=torch.float64),
            "background": torch.tensor([0.2, 0.9, 0.5], dtype=torch.float64),
        }

    for name, alpha in (("nothing painted", 0.0), ("something painted", 0.3)):
        yield Case(
            name=f"empty mask, {name}",
            build=rounded(lambda alpha=alpha: frame(alpha)),  # type: ignore[misc]
            **shared,
        )


LOSSES: tuple[Case, ...] = (
    *_pictures(),
    *_networks(),
    *_sure_judges(),
    *_segmentation(),
    *_masks(),
)
