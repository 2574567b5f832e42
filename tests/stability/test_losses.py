"""D-SSIM on nearly flat images and under autocast."""

import pytest
import torch
from kornia.losses import ssim_loss

from gsgan.losses.photometric import d_ssim
from stability.cases.losses import PAIRS


def test_the_usual_forms_float32_slope_is_wrong_on_nearly_flat_images():
    """Why D-SSIM is not kornia's: the same images, the same window, float32 against float64."""

    def slope(loss, dtype):
        image, target = (
            x.float().to(dtype) for x in PAIRS["nearly flat images"]
        )
        image.requires_grad_()
        loss(image, target).backward()
        return image.grad.double()

    def off(loss):
        exact = slope(loss, torch.float64)
        return float(
            (slope(loss, torch.float32) - exact).abs().max() / exact.abs().max()
        )

    assert off(lambda a, b: 2 * ssim_loss(a, b, 11)) > 0.05
    assert off(d_ssim) < 1e-5


@pytest.mark.parametrize("half", [torch.bfloat16, torch.float16])
def test_autocast_does_not_reach_ssim(half):
    image, target = (x.float() for x in PAIRS["ordinary images"])
    plain = d_ssim(image, target)
    with torch.autocast("cpu", dtype=half):
        assert torch.equal(d_ssim(image, target), plain)
