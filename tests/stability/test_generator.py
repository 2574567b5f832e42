"""What half precision may and may not change."""

import pytest
import torch
from torch.nn import functional

from gsgan.model.generator import StyleModulation

HALVES = (torch.bfloat16, torch.float16)


@pytest.mark.parametrize("size", [1e-4, 1.0, 300.0, 6e4])
def test_half_precision_normalises_what_its_squares_cannot_hold(size):
    """fp16 squares overflow above 256 and vanish below 2e-4; the norm is one all the same."""
    style = StyleModulation(4, 2, 3)
    h = torch.tensor([1.0, -1.0, 1.0, -1.0]).view(1, 4, 1, 1) * size
    with torch.autocast("cpu", dtype=torch.float16):
        out = style(h.half(), torch.zeros(1, 2, 1, 1), torch.zeros(1, 3))
    expected = functional.leaky_relu(h / (size**2 + 1e-6) ** 0.5, 0.2)
    torch.testing.assert_close(out.float(), expected, rtol=2e-3, atol=0)


@pytest.mark.parametrize("half", HALVES)
def test_geometry_and_rasteriser_stay_in_float32_under_autocast(build, half):
    """F, alpha, S and Ĝ bit for bit; the image to the type's own rounding."""
    _, avatar, frame = build(
        "size.rgb_skip=false"
    )  # else the image starts as F itself
    with torch.no_grad():
        plain = avatar(*frame.inputs)
        with torch.autocast("cpu", dtype=half):
            mixed = avatar(*frame.inputs)
    for name in ("features", "splat_alpha", "segmentation"):
        assert torch.equal(getattr(mixed, name), getattr(plain, name)), name
    assert torch.equal(mixed.gaussians.means, plain.gaussians.means)
    assert torch.equal(mixed.gaussians.covariances, plain.gaussians.covariances)
    assert mixed.image.dtype == torch.float32
    # of the largest value an untrained network paints, which is beyond what an image holds
    # (bfloat16: 0.082 on a processor without instructions for it)
    limit = (0.1 if half == torch.bfloat16 else 0.02) * float(
        plain.image.abs().max()
    )
    assert float((mixed.image - plain.image).abs().max()) < limit
