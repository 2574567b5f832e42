"""What teaches alpha: the splats' in step one, the generator's in step two."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from gsgan.model.rendering import Rendering
from gsgan.train.losses import StepOneLoss, StepTwoLoss

STEP_ONE = {
    "l1": 0.8,
    "ssim": 0.2,
    "feature_head": 0.5,
    "perceptual": 0.0,
    "perceptual_from": 0.3,
}
NETWORKS = {
    "perceptual": 1.0,
    "perceptual_every": 1,
    "adversarial": 1.0,
    "feature_matching": 10.0,
    "gan": "logistic",
    "anchor": 1.0,
}


def leaves(*channels: int, size: int = 16) -> list[torch.Tensor]:
    """Random pictures that take a gradient."""
    generator = torch.Generator().manual_seed(0)
    return [
        torch.rand(1, n, size, size, generator=generator).requires_grad_()
        for n in channels
    ]


def seen_person(size: int = 16) -> SimpleNamespace:
    """A person in the middle, ignored at the right side."""
    mask, ignored = torch.zeros(1, 1, size, size), torch.zeros(1, 1, size, size)
    mask[..., 4:12, 4:12], ignored[..., 13:] = 1.0, 1.0
    return SimpleNamespace(
        image=0.4 * mask.expand(1, 3, -1, -1), mask=mask, ignored=ignored
    )


def test_step_two_compares_on_white_by_alpha_and_mask():
    image, alpha = leaves(3, 1)
    frame = seen_person()
    weights = StepTwoLoss(l1=0.5, l2=3.0, ssim=0.0, alpha=2.0, **NETWORKS)

    def terms(loss: StepTwoLoss) -> dict[str, torch.Tensor]:
        painting = Rendering(image, alpha)
        return loss.terms(
            painting,
            frame,
            anchor=None,
            perceptual=None,
            draws=None,
            maps=None,
            step=0,
        )

    found = terms(weights)
    off = ((image + 1 - alpha) - (frame.image + 1 - frame.mask)).detach() * (
        frame.ignored == 0
    )
    assert float(found["alpha"].detach()) == pytest.approx(
        2 * float(0.5 * off.abs().mean() + 3 * off.square().mean()), rel=1e-5
    )
    (slope,) = torch.autograd.grad(found["alpha"], alpha)
    expected = (
        -2 * (0.5 * off.sign() + 6 * off).sum(1, keepdim=True) / off.numel()
    )
    torch.testing.assert_close(slope, expected)
    assert torch.autograd.grad(
        found["photometric"], alpha, allow_unused=True
    ) == (None,)
    assert set(terms(replace(weights, alpha=0.0))) == {"photometric"}


def test_the_generators_fourth_channel_learns_from_alpha_alone(make):
    module, _, data = make(
        "size.rgb_skip=false", "training.step_two.perceptual_every=1"
    )
    frame = data.dataset("train")[0]
    last = module.avatar.generator.paint.weight
    painting = module.avatar(*frame.inputs)
    maps = module.step_two.discriminator_maps(
        module.discriminator, painting, frame
    )
    terms = module.step_two_terms(painting, frame, maps)
    assert {"alpha", "photometric", "anchor", "adversarial"} <= set(terms)
    slopes = {
        name: torch.autograd.grad(
            term, last, retain_graph=True, allow_unused=True
        )[0]
        for name, term in terms.items()
    }
    assert bool(slopes["alpha"][3].any())
    assert bool(
        slopes["alpha"][:3].any()
    )  # the image on white is its colours, too
    for name in terms.keys() - {"alpha", "anchor"}:
        assert bool(slopes[name][:3].any()), name
        assert not slopes[name][3].any(), name
    assert slopes["anchor"] is None  # of what is splatted


def test_on_black_step_one_compares_the_splats_alpha_with_the_mask():
    features, alpha = leaves(5, 1)
    frame, colour = (
        seen_person(),
        torch.tensor([0.2, 0.9, 0.5]).view(1, 3, 1, 1),
    )
    painting = Rendering(None, features=features, splat_alpha=alpha)
    with_alpha, without = (
        StepOneLoss(alpha=weight, **STEP_ONE) for weight in (0.3, 0.0)
    )
    on_black = with_alpha(painting, frame, None, None)
    (slope,) = torch.autograd.grad(on_black, alpha)
    off = (alpha - frame.mask).detach() * (frame.ignored == 0)
    torch.testing.assert_close(slope, 0.3 * off.sign() / off.numel())
    black = without(painting, frame, None, None)
    assert torch.autograd.grad(black, alpha, allow_unused=True) == (None,)
    assert float((on_black - black).detach()) == pytest.approx(
        0.3 * float(off.abs().mean())
    )
    # a colour behind her teaches alpha by itself
    over = with_alpha(painting, frame, colour, None)
    assert torch.equal(over, without(painting, frame, colour, None))
    assert bool(torch.autograd.grad(over, alpha)[0].any())
