"""A frozen avatar paints as the avatar in training does, and follows its weights."""

import copy

import pytest
import torch

MODELS = [
    *(
        (model, "none")
        for model in ("full", "wo_gcn", "lbs_splat", "image_to_image")
    ),
    *(
        (model, "all")
        for model in ("full", "wo_seg", "lbs_splat", "splat_only", "harmonic")
    ),
]


def left_of_zero(avatar):
    """Out of the zero starts, where much would be equal whatever it was computed from."""
    torch.manual_seed(1)
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    return avatar.eval()


def psnr(a, b) -> float:
    return float(
        -10 * (a.double() - b.double()).square().mean().clamp_min(1e-30).log10()
    )


@pytest.mark.parametrize(("model", "effects"), MODELS)
def test_the_image_is_that_of_training(build, model, effects):
    _, avatar, frame = build(f"model={model}", f"effects={effects}")
    trained = left_of_zero(avatar)(*frame.inputs)
    frozen = copy.deepcopy(avatar).freeze()
    for _ in range(2):  # computed, then kept
        with torch.inference_mode():
            painting = frozen(*frame.inputs)
        assert psnr(painting.image, trained.image.detach()) > 90
    assert not any(p.requires_grad for p in frozen.parameters())
    assert trained.image.requires_grad


@pytest.mark.parametrize(
    ("model", "channels"), [("splat_only", 3), ("harmonic", 3), ("full", 5)]
)
def test_features_that_nothing_reads_are_not_painted(build, model, channels):
    _, avatar, frame = build(f"model={model}")
    assert avatar(*frame.inputs).features.shape[1] == 5
    with torch.inference_mode():
        frozen = avatar.freeze()
        assert frozen(*frame.inputs).features.shape[1] == channels
    assert frozen.splat_channels == channels


def test_it_follows_the_weights(build):
    _, avatar, frame = build("size.rgb_skip=false")
    frozen = copy.deepcopy(left_of_zero(avatar)).freeze()
    with torch.inference_mode():
        before = frozen(*frame.inputs).image
    with torch.no_grad():
        for parameter in avatar.parameters():
            parameter.mul_(1.1)
    expected = avatar(*frame.inputs).image.detach()
    assert psnr(before, expected) < 60
    frozen.load_state_dict(avatar.state_dict())
    with torch.inference_mode():
        assert psnr(frozen(*frame.inputs).image, expected) > 90
    again = copy.deepcopy(avatar).freeze()
    assert torch.equal(again(*frame.inputs).image, frozen(*frame.inputs).image)


def test_gradients_still_reach_the_skeleton(build):
    _, avatar, frame = build()
    frozen = left_of_zero(avatar).freeze()
    with torch.inference_mode():
        frozen(
            *frame.inputs
        )  # what is kept from here on can be used with gradients
    p = frame.skeleton.clone().requires_grad_()
    frozen(p, frame.visibility, frame.camera, frame.body).image.sum().backward()
    assert float(p.grad.abs().max()) > 0
