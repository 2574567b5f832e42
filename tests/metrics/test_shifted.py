"""A block that is a pixel off fits; colours that are wrong, or two pixels off, do not."""

import math

import pytest
import torch

from gsgan.metrics.image import person_box, psnr_where
from gsgan.metrics.shifted import BLOCK, psnr_shifted

SIDE = 64
GENERATOR = torch.Generator().manual_seed(0)
TARGET = torch.rand(1, 3, SIDE, SIDE, generator=GENERATOR)
MASK = torch.zeros(1, 1, SIDE, SIDE)
# 2 × 2 blocks, and parts of blocks at their ends.
MASK[..., 8 : 8 + 2 * BLOCK + 3, 10 : 10 + 2 * BLOCK + 5] = 1


def in_box(image: torch.Tensor) -> float:
    return float(psnr_where(image, TARGET, person_box(MASK)))


@pytest.mark.parametrize("shift", [(0, 0), (1, 0), (0, -1), (-1, 1)])
def test_an_image_that_is_a_pixel_off_fits(shift):
    image = TARGET.roll(shift, dims=(-2, -1))
    assert float(psnr_shifted(image, TARGET, MASK)) == math.inf


def waves(offset: float) -> torch.Tensor:
    """Waves of 9 by 13 pixels, moved to the left by ``offset`` pixels."""
    x = torch.arange(SIDE) + offset
    y = torch.arange(SIDE)[:, None]
    grey = 0.5 + 0.3 * torch.sin(2 * math.pi * (x / 9 + y / 13))
    return grey.expand(1, 3, -1, -1)


def test_half_a_pixel_nearly_fits():
    target = waves(0)
    plain = float(psnr_where(waves(0.5), target, person_box(MASK)))
    assert plain < 25
    assert float(psnr_shifted(waves(0.5), target, MASK)) > plain + 15


def test_each_block_has_a_shift_of_its_own():
    image = TARGET.clone()
    middle = 8 + BLOCK
    image[..., :middle, :] = TARGET.roll(1, dims=-1)[..., :middle, :]
    image[..., middle:, :] = TARGET.roll(-1, dims=-1)[..., middle:, :]
    assert float(psnr_shifted(image, TARGET, MASK)) == math.inf


def test_two_pixels_are_too_far():
    image = TARGET.roll(2, dims=-1)
    assert float(psnr_shifted(image, TARGET, MASK)) < 12


def test_colours_that_are_wrong_stay_wrong():
    image = TARGET + 0.1
    assert float(psnr_shifted(image, TARGET, MASK)) == pytest.approx(
        20, abs=1e-4
    )
    moved = image.roll(1, dims=-2)
    assert float(psnr_shifted(moved, TARGET, MASK)) == pytest.approx(
        20, abs=1e-4
    )


def test_it_is_never_below_the_psnr_in_the_box():
    noise = torch.randn(TARGET.shape, generator=GENERATOR)
    for share in (0.01, 0.1, 0.5):
        image = TARGET + share * noise
        assert float(psnr_shifted(image, TARGET, MASK)) >= in_box(image) - 1e-4


def test_a_box_at_the_images_border_and_an_empty_one():
    everywhere = torch.ones_like(MASK)
    assert float(psnr_shifted(TARGET, TARGET, everywhere)) == math.inf
    assert math.isnan(
        float(psnr_shifted(TARGET, TARGET, torch.zeros_like(MASK)))
    )
