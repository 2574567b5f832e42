"""The generator paints the part of the window in which something was splatted."""

import pytest
import torch

from gsgan.scene import cat, painted_window


def alpha_at(*boxes: tuple[int, int, int, int]) -> torch.Tensor:
    """``[B, 1, 64, 96]`` ones in a box of rows and columns per item."""
    alpha = torch.zeros(len(boxes), 1, 64, 96)
    for image, (top, bottom, left, right) in zip(alpha, boxes, strict=True):
        image[:, top:bottom, left:right] = 1
    return alpha


def test_boxes_hold_all_that_is_painted_and_begin_at_multiples():
    alpha = alpha_at((20, 40, 30, 50), (3, 10, 80, 96))
    window = painted_window(alpha, margin=5, multiple=16)
    assert window.whole == (64, 96)
    assert window.size == (
        48,
        48,
    )  # rows 0 to 45 of the first, columns 16 to 55
    assert window.corners == ((0, 16), (0, 48))
    assert torch.equal(window.paste(window.cut(alpha)), alpha)


def test_an_image_without_splats_has_the_smallest_box():
    window = painted_window(torch.zeros(1, 1, 64, 96), margin=5, multiple=16)
    assert window.size == (16, 16)


def test_a_box_ends_with_its_image():
    alpha = torch.ones(1, 1, 50, 70)
    window = painted_window(alpha, margin=8, multiple=16)
    assert window.size == (50, 70)
    assert window.corners == ((0, 0),)


@pytest.mark.parametrize("supersample", [1, 2])
def test_the_image_is_that_of_the_whole_window(build, supersample):
    """Only near the box's border does the generator see zeros in place of background."""
    data, avatar, frame = build(
        f"size.supersample={supersample}", "data.size=64", "data.crop=null"
    )
    frame = cat([frame, data.dataset("train")[5]])
    avatar.eval()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in avatar.parameters():
            noise = torch.randn(parameter.shape, generator=generator)
            parameter += 0.03 * noise
        part = avatar(*frame.inputs)
        avatar.generator_margin = None
        whole = avatar(*frame.inputs)
    assert torch.equal(part.features, whole.features)
    assert torch.equal(part.splat_alpha, whole.splat_alpha)
    person = whole.splat_alpha > 0.5
    difference = ((part.image - whole.image).abs() * person).amax()
    assert 0 < difference < 0.02
    assert whole.image.abs().amax() > 0.2


def test_training_paints_the_whole_window(build):
    _, avatar, frame = build()
    avatar.train()
    painting = avatar(*frame.inputs)
    avatar.generator_margin = None
    assert torch.equal(painting.image, avatar(*frame.inputs).image)
