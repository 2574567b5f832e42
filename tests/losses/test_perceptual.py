"""The perceptual loss: networks and forms, measured layer weights, crops of the person."""

import math

import pytest
import torch

from gsgan.losses.perceptual import Perceptual, crop_person
from gsgan.utils.errors import ConfigError


def picture(seed: int = 0, size: int = 64) -> torch.Tensor:
    return torch.rand(
        1, 3, size, size, generator=torch.Generator().manual_seed(seed)
    )


def test_the_random_network_is_marked_fixed_and_not_saved():
    torch.manual_seed(1)
    one = Perceptual("random")
    torch.manual_seed(2)
    two = Perceptual("random")
    assert "random" in one.mark
    assert torch.equal(one(picture(0), picture(1)), two(picture(0), picture(1)))
    assert float(one(picture(0), picture(0))) == 0
    assert not any("network" in key for key in one.state_dict())
    two.load_state_dict(one.state_dict())
    assert not any(p.requires_grad for p in one.parameters())


def test_layer_weights_are_measured_then_frozen():
    loss = Perceptual("random", warmup=2)
    loss(picture(0), picture(1))
    loss(picture(0), picture(2))
    frozen = loss.layer_loss.clone()
    loss(picture(0), picture(0) * 0)
    assert torch.equal(loss.layer_loss, frozen)
    assert int(loss.calls) == 2
    resumed = Perceptual(
        "random", warmup=2
    )  # the weights are in the checkpoint
    resumed.load_state_dict(loss.state_dict())
    assert torch.equal(
        resumed(picture(3), picture(4)), loss(picture(3), picture(4))
    )
    assert torch.equal(resumed.layer_loss, frozen)


@pytest.mark.usefixtures("weights")
@pytest.mark.parametrize("net", ["vgg", "alex"])
@pytest.mark.parametrize("form", ["features", "lpips"])
def test_pretrained_networks_see_a_difference_and_pass_its_gradient(net, form):
    loss = Perceptual(net=net, form=form)
    assert loss.mark is None
    assert not [key for key in loss.state_dict() if "network" in key]
    assert not any(p.requires_grad for p in loss.parameters())
    image = picture(0).requires_grad_()
    assert float(loss(image, image.detach())) == 0
    value = loss(image, picture(1))
    value.backward()
    assert float(value) > 0
    assert torch.isfinite(image.grad).all()
    assert float(image.grad.abs().max()) > 0
    resumed = Perceptual(net=net, form=form)
    resumed.load_state_dict(loss.state_dict())
    assert torch.equal(
        resumed(picture(2), picture(3)), loss(picture(2), picture(3))
    )


@pytest.mark.usefixtures("weights")
def test_the_papers_layers_are_the_first_four_of_vgg():
    shapes = [
        tuple(f.shape[1:]) for f in Perceptual().network(picture(size=32))
    ]
    assert shapes == [(64, 32, 32), (128, 16, 16), (256, 8, 8), (512, 4, 4)]


@pytest.mark.usefixtures("weights")
def test_the_form_lpips_is_lpips():
    from gsgan.metrics.lpips import build_lpips

    loss = Perceptual(net="alex", form="lpips")
    expected = build_lpips(["alex"])["alex"](picture(0), picture(1))
    assert math.isclose(
        float(loss(picture(0), picture(1))), float(expected), rel_tol=1e-6
    )


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"weights": "auto"}, "training.perceptual.weights"),
        ({"net": "squeeze"}, "training.perceptual.net"),
        ({"form": "gram"}, "training.perceptual.form"),
        ({"weights": "random", "crop": 31}, "training.perceptual.crop"),
        ({"weights": "random", "crops": 0}, "training.perceptual.crops"),
    ],
)
def test_unknown_values_are_refused(given, named):
    with pytest.raises(ConfigError, match=named):
        Perceptual(**given)


# -- crops


def coordinates(batch: int, height: int, width: int) -> torch.Tensor:
    """Images whose channels are the row, the column and the place in the batch."""
    y, x = torch.meshgrid(
        torch.arange(height), torch.arange(width), indexing="ij"
    )
    b = torch.arange(batch)[:, None, None].expand(batch, height, width)
    return torch.stack([y.expand_as(b), x.expand_as(b), b], dim=1).float()


def test_crops_are_whole_squares_around_pixels_of_the_person():
    image = coordinates(2, 80, 100)
    mask = torch.zeros(2, 1, 80, 100)
    mask[0, 0, 40:44, 50:54] = 1
    mask[1, 0, 0, 0] = 1  # in the corner: the square is moved inside
    draws = torch.rand(2, 5, generator=torch.Generator().manual_seed(0))
    cut, cut_mask = crop_person([image, mask], mask, draws, 32)
    assert cut.shape == (10, 3, 32, 32)
    assert cut_mask.shape == (10, 1, 32, 32)
    assert (cut_mask.amax(dim=(1, 2, 3)) == 1).all()  # the person is in each
    assert cut[:, 2].unique().tolist() == [0, 1]
    top, left = cut[:, 0, 0, 0], cut[:, 1, 0, 0]
    steps = torch.arange(32.0)
    assert torch.equal(
        cut[:, 0], (top[:, None, None] + steps[:, None]).expand(10, 32, 32)
    )
    assert torch.equal(
        cut[:, 1], (left[:, None, None] + steps).expand(10, 32, 32)
    )
    assert ((top[:5] >= 40 - 16) & (top[:5] < 44 - 16)).all()
    assert (top[5:] == 0).all()
    assert (left[5:] == 0).all()


def test_each_pixel_of_the_person_is_drawn_alike():
    mask = torch.zeros(1, 1, 64, 64)
    mask[..., 30:34, 20:40] = 1
    draws = (torch.arange(80.0)[None] + 0.5) / 80
    cut = crop_person([coordinates(1, 64, 64)], mask, draws, 32)[0]
    corners = torch.stack([cut[:, 0, 0, 0], cut[:, 1, 0, 0]], dim=1)
    assert len(corners.unique(dim=0)) == 80


@pytest.mark.parametrize("draw", [0.0, 0.5, 1 - 1e-7])
def test_small_images_and_images_without_a_person_are_cropped_too(draw):
    draws = torch.full((1, 1), draw)
    small = crop_person(
        [coordinates(1, 20, 100)], torch.ones(1, 1, 20, 100), draws, 32
    )[0]
    assert small.shape == (1, 3, 20, 32)
    nobody = crop_person(
        [coordinates(1, 64, 64)], torch.zeros(1, 1, 64, 64), draws, 32
    )[0]
    assert nobody.shape == (1, 3, 32, 32)


def test_a_crop_passes_the_gradient_to_its_pixels_alone():
    image = torch.rand(1, 3, 64, 64, requires_grad=True)
    mask = torch.zeros(1, 1, 64, 64)
    mask[..., 32, 32] = 1
    crop_person([image], mask, torch.full((1, 1), 0.5), 32)[0].sum().backward()
    expected = torch.zeros(1, 3, 64, 64)
    expected[..., 16:48, 16:48] = 1
    assert torch.equal(image.grad, expected)
