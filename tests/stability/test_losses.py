"""Losses and scores on hard images; what is infinite is counted, never averaged."""

from __future__ import annotations

import math

import pytest
import torch
from kornia.losses import ssim_loss
from torchmetrics.functional.image import structural_similarity_index_measure

from gsgan.evaluate.scores import image_scores, means
from gsgan.losses.photometric import d_ssim
from gsgan.metrics.image import psnr, ssim
from stability.cases.losses import PAIRS


@pytest.mark.parametrize("name", PAIRS)
def test_d_ssim_and_ssim_are_the_usual_ones(name):
    """In float64: torchmetrics' score to rounding, kornia's loss but for what it adds below."""
    image, target = PAIRS[name]
    halved = ssim_loss(image, target, 11)  # 1e-12 more in the quotient: 1e-5 on black
    torch.testing.assert_close(d_ssim(image, target), 2 * halved, atol=2e-5, rtol=0)
    score = structural_similarity_index_measure(image, target, data_range=1.0, reduction="none")
    torch.testing.assert_close(ssim(image, target), score.reshape(1), atol=1e-9, rtol=0)


def test_the_usual_forms_float32_slope_is_wrong_on_nearly_flat_images():
    """Why D-SSIM is not kornia's: the same images, the same window, float32 against float64."""

    def slope(loss, dtype):
        image, target = (x.float().to(dtype) for x in PAIRS["nearly flat images"])
        image.requires_grad_()
        loss(image, target).backward()
        return image.grad.double()

    def off(loss):
        exact = slope(loss, torch.float64)
        return float((slope(loss, torch.float32) - exact).abs().max() / exact.abs().max())

    assert off(lambda a, b: 2 * ssim_loss(a, b, 11)) > 0.05
    assert off(d_ssim) < 1e-5


def test_equal_images_score_1_and_infinity_which_stays_out_of_the_mean():
    grey, other = torch.full((1, 3, 24, 24), 0.7), torch.full((1, 3, 24, 24), 0.4)
    assert psnr(grey, grey).item() == math.inf
    assert ssim(grey, grey).item() == 1.0
    result = means([image_scores(image, grey) for image in (grey, other, grey)])
    assert result["psnr"] == pytest.approx(-20 * math.log10(0.3), rel=1e-5)
    assert result["psnr_left_out"] == 2
    assert "ssim_left_out" not in result


@pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
def test_autocast_does_not_reach_ssim(half):
    image, target = (x.float() for x in PAIRS["ordinary images"])
    plain = d_ssim(image, target)
    with torch.autocast("cpu", dtype=half):
        mixed = d_ssim(image, target)
    assert mixed.dtype == torch.float32
    assert torch.equal(mixed, plain)
