"""Maps of the part of an image that differs from its background equal those of the whole image."""

import pytest
import torch
from torch import nn

from gsgan.weights.parts import STRIP, BackgroundMaps

HEIGHT, WIDTH = 3 * STRIP + 7, 121


def build_stages(memory_format: torch.memory_format) -> nn.ModuleList:
    """Two stages with the layers of VGG and of AlexNet: strides, paddings, a pooling."""
    torch.manual_seed(0)
    first = nn.Sequential(nn.Conv2d(3, 8, 5, stride=2, padding=2), nn.ReLU())
    second = nn.Sequential(
        nn.MaxPool2d(3, 2), nn.Conv2d(8, 4, 3, padding=1), nn.ReLU()
    )
    stages = nn.ModuleList([first, second]).requires_grad_(False)
    return stages.to(memory_format=memory_format)


def paint(
    image: torch.Tensor, *boxes: tuple[int, int, int, int]
) -> torch.Tensor:
    """The image with noise in boxes of top, bottom, left and right."""
    generator = torch.Generator().manual_seed(1)
    painted = image.clone()
    for top, bottom, left, right in boxes:
        part = painted[..., top:bottom, left:right]
        part += torch.rand(part.shape, generator=generator)
    return painted


@pytest.mark.parametrize(
    "memory_format", [torch.contiguous_format, torch.channels_last]
)
@pytest.mark.parametrize(
    "boxes",
    [
        [
            (10, 14, 5, 9),
            (80, 90, 100, 110),
        ],  # two people, an empty strip between
        [
            (0, 1, 0, 1),
            (HEIGHT - 1, HEIGHT, WIDTH - 1, WIDTH),
        ],  # opposite corners
        [
            (30, 34, 60, 61),
            (60, 70, 0, WIDTH),
        ],  # a narrow strip above a wide one
        [(0, HEIGHT, 0, WIDTH)],
        [(STRIP, STRIP + 1, 0, 2)],
    ],
)
def test_maps_of_parts_are_the_maps_of_whole_images(boxes, memory_format):
    stages = build_stages(memory_format)
    grey = torch.full((1, 3, HEIGHT, WIDTH), 0.5)
    image = paint(grey, *boxes)
    background = BackgroundMaps(stages, grey)
    parts = background.differing(image)
    whole = image
    for stage, layers in enumerate(stages):
        whole = layers(whole)
        height, width = whole.shape[-2:]
        values = background.on(stage, parts, (0, height), (0, width))
        torch.testing.assert_close(values, whole, rtol=0, atol=1e-6)
        assert parts[stage].values.numel() <= whole.numel()


def test_an_image_of_the_background_has_no_parts():
    grey = torch.full((1, 3, HEIGHT, WIDTH), 0.5)
    background = BackgroundMaps(build_stages(torch.channels_last), grey)
    assert background.differing(grey.clone()) == []
