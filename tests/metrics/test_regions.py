"""What is scored of a picture: closed forms of backgrounds, 8 bits, clearing and crops."""

import cv2
import numpy as np
import pytest
import torch

from gsgan.metrics.regions import (
    clear,
    eight_bits,
    hard_outline,
    mask_crop,
    on_background,
    rectangle,
)


def test_a_premultiplied_image_lets_the_background_through():
    image = torch.tensor([0.3, 0.0, 0.0]).view(1, 1, 1, 3).expand(1, 3, 1, 3)
    alpha = torch.tensor([1.0, 0.5, 0.0]).view(1, 1, 1, 3)
    assert on_background(image, alpha, 1.0)[0, 0, 0].tolist() == pytest.approx(
        [0.3, 0.5, 1.0]
    )
    assert torch.equal(on_background(image, alpha, 0.0), image)


def test_eight_bits():
    image = torch.tensor([0.0, 0.9 / 255, 1.2 / 255, 1.0]).view(1, 1, 1, 4)
    assert torch.equal(eight_bits(image, "none"), image)
    rounded, cut = (
        (eight_bits(image, how) * 255).flatten().tolist()
        for how in ("rounded", "cut")
    )
    assert rounded == pytest.approx([0, 1, 1, 255])
    assert cut == pytest.approx([0, 0, 1, 255])


@pytest.mark.parametrize("how", ["rounded", "cut"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_8_bit_already_stays(how, dtype):
    stored = torch.arange(256).to(dtype).view(1, 1, 16, 16) / 255
    assert torch.equal(
        (eight_bits(stored, how) * 255).round(), (stored * 255).round()
    )


def test_cleared_pixels_are_background():
    image = torch.full((1, 3, 2, 2), 0.5)
    keep = torch.tensor([[True, False], [False, True]]).view(1, 1, 2, 2)
    assert clear(image, keep, 1.0)[0, 0].tolist() == [[0.5, 1.0], [1.0, 0.5]]


def test_a_hard_outline_is_the_image_as_it_was_taken():
    taken = (
        torch.tensor([0.8, 0.8, 0.8, 0.8]).view(1, 1, 1, 4).expand(1, 3, 1, 4)
    )
    mask = torch.tensor([1.0, 0.5, 0.49, 0.0]).view(1, 1, 1, 4)
    found = hard_outline(taken * mask, mask)
    assert found[0, 0, 0].tolist() == pytest.approx([0.8, 0.8, 0.0, 0.0])
    assert (
        float(
            hard_outline(
                torch.ones(1, 3, 1, 1), torch.full((1, 1, 1, 1), 0.6)
            ).max()
        )
        == 1.0
    )


def test_rectangle():
    where = torch.zeros(1, 6, 7, dtype=torch.bool)
    assert rectangle(where) is None
    where[0, 2, 3] = where[0, 4, 1] = True
    assert rectangle(where) == (slice(2, 5), slice(1, 4))


def test_the_crop_is_square_centred_on_the_background():
    """A mask of 3 x 5 pixels and a margin of 1: 4 x 6 pixels, one less than it might be below and
    to the right, in a square of 6."""
    picture, mask = torch.full((3, 20, 20), 0.25), torch.zeros(1, 20, 20)
    mask[0, 5:8, 8:13] = 0.5
    square = mask_crop(picture, mask, 1.0, margin=1, size=6)
    expected = torch.full((3, 6, 6), 0.25)
    expected[:, [0, 5]] = 1.0
    assert torch.equal(square, expected)
    large = mask_crop(picture, mask, 1.0, margin=1, size=12)
    assert large.shape == (3, 12, 12)
    assert large[:, 4:8].min() == large[:, 4:8].max() == 0.25
    assert mask_crop(picture, torch.zeros(1, 20, 20), 1.0) is None


def test_the_crops_margin_ends_at_the_images_border():
    picture, mask = (
        torch.arange(400.0).view(1, 20, 20).expand(3, 20, 20) / 400,
        torch.zeros(1, 20, 20),
    )
    mask[0, 0:5, 18:20] = 1
    square = mask_crop(picture, mask, 1.0, margin=2, size=6)
    assert torch.equal(square[:, :, 1:5], picture[:, 0:6, 16:20])
    assert bool((square[:, :, [0, 5]] == 1).all())


def test_the_crop_shrinks_as_opencv_interpolates():
    """No low-pass before it: what a published score's script does."""
    picture, mask = torch.rand(3, 40, 44), torch.zeros(1, 40, 44)
    mask[0, 10:31, 12:33] = 1
    square = mask_crop(picture, mask, 1.0, margin=4, size=16)
    part = picture[:, 6:34, 8:36].permute(1, 2, 0).numpy()
    expected = cv2.resize(
        np.ascontiguousarray(part), (16, 16), interpolation=cv2.INTER_LINEAR
    )
    assert np.abs(square.permute(1, 2, 0).numpy() - expected).max() < 1e-5


@pytest.mark.parametrize(
    ("box", "minimum", "expected"),
    [
        ((10, 14, 20, 30), 1, (slice(10, 14), slice(20, 30))),
        ((10, 14, 20, 30), 16, (slice(4, 20), slice(17, 33))),
        (
            (0, 4, 36, 40),
            16,
            (slice(0, 16), slice(24, 40)),
        ),  # pushed in at the border
        # as far as the picture reaches
        ((10, 14, 20, 30), 64, (slice(0, 40), slice(0, 40))),
    ],
)
def test_a_rectangle_is_widened_as_asked(box, minimum, expected):
    where = torch.zeros(1, 40, 40, dtype=torch.bool)
    where[:, box[0] : box[1], box[2] : box[3]] = True
    assert rectangle(where, minimum) == expected
