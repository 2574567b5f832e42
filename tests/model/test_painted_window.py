"""The generator paints the part of the window in which something was splatted."""

from dataclasses import replace

import pytest
import torch

from gsgan.model.painted import find_window
from gsgan.scene import cat


def alpha_at(*boxes: tuple[int, int, int, int]) -> torch.Tensor:
    """``[B, 1, 64, 96]`` ones in a box of rows and columns per item."""
    alpha = torch.zeros(len(boxes), 1, 64, 96)
    for image, (top, bottom, left, right) in zip(alpha, boxes, strict=True):
        image[:, top:bottom, left:right] = 1
    return alpha


def test_boxes_hold_all_that_is_painted_and_begin_at_multiples():
    alpha = alpha_at((20, 40, 30, 50), (3, 10, 80, 96))
    window = find_window(alpha, margin=5, multiple=16)
    assert window.whole == (64, 96)
    # rows 0 to 45 of the first, columns 16 to 55
    assert window.size == (48, 48)
    assert window.corners == ((0, 16), (0, 48))
    assert torch.equal(window.paste(window.cut(alpha)), alpha)


def test_an_image_without_splats_has_the_smallest_box():
    window = find_window(torch.zeros(1, 1, 64, 96), margin=5, multiple=16)
    assert window.size == (16, 16)


def test_a_box_ends_with_its_image():
    alpha = torch.ones(1, 1, 50, 70)
    window = find_window(alpha, margin=8, multiple=16)
    assert window.size == (50, 70)
    assert window.corners == ((0, 0),)


@pytest.mark.parametrize("supersample", [1, 2])
def test_the_image_is_that_of_a_camera_that_sees_the_box(build, supersample):
    data, avatar, frame = build(
        f"size.supersample={supersample}",
        "data.size=96",
        "data.crop=null",
        "model.window_margin=null",
    )
    frame = cat([frame, data.dataset("train")[5]])
    avatar.eval()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in avatar.parameters():
            noise = torch.randn(parameter.shape, generator=generator)
            parameter += 0.03 * noise
        painted = avatar(*frame.inputs)
        avatar.generator_margin = None
        whole = avatar(*frame.inputs)
        box = find_window(
            whole.splat_alpha, margin=8, multiple=avatar.window_multiple
        )
        seen = replace(frame, camera=box.camera(frame.camera))
        cut = avatar(*seen.inputs)
    assert box.size == (96, 64)
    for name in ("image", "alpha", "segmentation", "features"):
        torch.testing.assert_close(
            box.cut(getattr(painted, name)),
            getattr(cut, name),
            atol=1e-3,
            rtol=0,
            msg=lambda text, name=name: f"{name}: {text}",
        )

    # Nothing that was splatted is lost, and outside there is nobody.
    torch.testing.assert_close(painted.features, whole.features)
    torch.testing.assert_close(painted.splat_alpha, whole.splat_alpha)
    assert not box.cut(painted.image).equal(box.cut(whole.image))
    outside = box.paste(torch.ones(2, 1, *box.size)) == 0
    assert not (painted.image * outside).any()
    torch.testing.assert_close(
        painted.segmentation.sum(dim=1), torch.ones(2, 96, 96)
    )


def test_training_paints_the_whole_window(build):
    _, avatar, frame = build()
    avatar.train()
    painting = avatar(*frame.inputs)
    avatar.generator_margin = None
    assert torch.equal(painting.image, avatar(*frame.inputs).image)
