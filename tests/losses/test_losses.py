"""Losses of photometry and of the GAN: closed forms, signs, hard inputs."""

import math

import pytest
import torch

from gsgan.losses.adversarial import (
    discriminator_loss,
    feature_matching,
    generator_loss,
)
from gsgan.losses.photometric import d_ssim, photometric


def picture(seed: int = 0) -> torch.Tensor:
    return torch.rand(
        1, 3, 24, 24, generator=torch.Generator().manual_seed(seed)
    )


def test_d_ssim_is_one_minus_ssim():
    from torchmetrics.functional.image import (
        structural_similarity_index_measure as reference,
    )

    a, b = picture(0), picture(1)
    assert math.isclose(float(d_ssim(a, a)), 0.0, abs_tol=1e-6)
    expected = 1 - float(reference(a, b, data_range=1.0))
    # borders are treated apart
    assert math.isclose(float(d_ssim(a, b)), expected, abs_tol=0.02)


def test_photometric_weights():
    a, b = torch.full((1, 3, 16, 16), 0.5), torch.full((1, 3, 16, 16), 0.3)
    assert math.isclose(
        float(photometric(a, b, l1=1, l2=0, ssim=0)), 0.2, rel_tol=1e-5
    )
    assert math.isclose(
        float(photometric(a, b, l1=0, l2=1, ssim=0)), 0.04, rel_tol=1e-5
    )
    assert float(photometric(a, b, l1=0, l2=0, ssim=0)) == 0


def maps(value: float) -> list[list[torch.Tensor]]:
    return [
        [torch.full((1, 2, 4, 4), 0.0), torch.full((1, 1, 4, 4), value)],
        [torch.full((1, 2, 2, 2), 0.0), torch.full((1, 1, 2, 2), value)],
    ]


@pytest.mark.parametrize(
    ("form", "at_real", "at_fake", "for_generator"),
    [
        (
            "logistic",
            math.log1p(math.exp(-2)),
            math.log1p(math.exp(2)),
            math.log1p(math.exp(-2)),
        ),
        ("hinge", 0.0, 3.0, -2.0),
        ("lsgan", 1.0, 4.0, 1.0),
        ("relativistic", math.log(2), 0.0, math.log(2)),
    ],
)
def test_gan_closed_forms(form, at_real, at_fake, for_generator):
    """All logits at 2, two scales summed."""
    total = float(discriminator_loss(maps(2.0), maps(2.0), form))
    assert math.isclose(total, 2 * (at_real + at_fake), rel_tol=1e-5)
    assert math.isclose(
        float(generator_loss(maps(2.0), maps(2.0), form)),
        2 * for_generator,
        rel_tol=1e-5,
    )


def test_a_relativistic_loss_sees_only_how_the_pair_differs():
    for shift in (0.0, 7.0):
        real, fake = maps(shift + 3.0), maps(shift + 1.0)
        judged, painted = (
            float(loss(real, fake, "relativistic"))
            for loss in (discriminator_loss, generator_loss)
        )
        assert math.isclose(judged, 2 * math.log1p(math.exp(-2)), rel_tol=1e-5)
        assert math.isclose(painted, 2 * math.log1p(math.exp(2)), rel_tol=1e-5)


def test_feature_matching_leaves_logits_and_real_side_out():
    real, fake = maps(1.0), maps(5.0)
    assert float(feature_matching(real, fake)) == 0  # only the logits differ
    real[0][0] = torch.ones(1, 2, 4, 4, requires_grad=True)
    fake[0][0].requires_grad_()
    loss = feature_matching(real, fake)
    loss.backward()
    assert math.isclose(float(loss), 4 / (1 * 2), rel_tol=1e-6)
    assert real[0][0].grad is None
