"""Losses: closed forms, signs, hard inputs, and what stands in for VGG."""

import math

import pytest
import torch

from gsgan.losses.adversarial import discriminator_loss, feature_matching, generator_loss
from gsgan.losses.perceptual import FILES, Perceptual, find_weights, load_weights
from gsgan.losses.photometric import d_ssim, photometric
from gsgan.utils.errors import ConfigError, DataError


def picture(seed: int = 0) -> torch.Tensor:
    return torch.rand(1, 3, 24, 24, generator=torch.Generator().manual_seed(seed))


def test_d_ssim_is_one_minus_ssim():
    from torchmetrics.functional.image import structural_similarity_index_measure as reference

    a, b = picture(0), picture(1)
    assert math.isclose(float(d_ssim(a, a)), 0.0, abs_tol=1e-6)
    expected = 1 - float(reference(a, b, data_range=1.0))
    assert math.isclose(float(d_ssim(a, b)), expected, abs_tol=0.02)  # borders are treated apart


def test_photometric_weights():
    a, b = torch.full((1, 3, 16, 16), 0.5), torch.full((1, 3, 16, 16), 0.3)
    assert math.isclose(float(photometric(a, b, l1=1, l2=0, ssim=0)), 0.2, rel_tol=1e-5)
    assert math.isclose(float(photometric(a, b, l1=0, l2=1, ssim=0)), 0.04, rel_tol=1e-5)
    assert float(photometric(a, b, l1=0, l2=0, ssim=0)) == 0


def maps(value: float) -> list[list[torch.Tensor]]:
    return [
        [torch.full((1, 2, 4, 4), 0.0), torch.full((1, 1, 4, 4), value)],
        [torch.full((1, 2, 2, 2), 0.0), torch.full((1, 1, 2, 2), value)],
    ]


@pytest.mark.parametrize(
    ("form", "at_real", "at_fake", "for_generator"),
    [
        ("logistic", math.log1p(math.exp(-2)), math.log1p(math.exp(2)), math.log1p(math.exp(-2))),
        ("hinge", 0.0, 3.0, -2.0),
        ("lsgan", 1.0, 4.0, 1.0),
        ("relativistic", math.log(2), 0.0, math.log(2)),
    ],
)
def test_gan_closed_forms(form, at_real, at_fake, for_generator):
    """All logits at 2, two scales summed."""
    total = float(discriminator_loss(maps(2.0), maps(2.0), form))
    assert math.isclose(total, 2 * (at_real + at_fake), rel_tol=1e-5)
    assert math.isclose(
        float(generator_loss(maps(2.0), maps(2.0), form)), 2 * for_generator, rel_tol=1e-5
    )


def test_a_relativistic_loss_sees_only_how_the_pair_differs():
    for shift in (0.0, 7.0):
        real, fake = maps(shift + 3.0), maps(shift + 1.0)
        judged, painted = (
            float(loss(real, fake, "relativistic")) for loss in (discriminator_loss, generator_loss)
        )
        assert math.isclose(judged, 2 * math.log1p(math.exp(-2)), rel_tol=1e-5)
        assert math.isclose(painted, 2 * math.log1p(math.exp(2)), rel_tol=1e-5)


def test_feature_matching_leaves_logits_and_real_side_out():
    real, fake = maps(1.0), maps(5.0)
    assert float(feature_matching(real, fake)) == 0  # only the logits differ
    real[0][0] = torch.ones(1, 2, 4, 4, requires_grad=True)
    fake[0][0].requires_grad_()
    loss = feature_matching(real, fake)
    loss.backward()
    assert math.isclose(float(loss), 4 / (1 * 2), rel_tol=1e-6)
    assert real[0][0].grad is None


def test_perceptual_stand_in_is_marked_fixed_and_not_saved(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    torch.manual_seed(1)
    one = Perceptual("auto")
    torch.manual_seed(2)
    two = Perceptual("auto")
    assert "random" in one.mark
    assert torch.equal(one(picture(0), picture(1)), two(picture(0), picture(1)))
    assert float(one(picture(0), picture(0))) == 0
    assert not any("stages" in key for key in one.state_dict())
    two.load_state_dict(one.state_dict())
    assert not any(p.requires_grad for p in one.parameters())


def test_perceptual_layer_weights_are_measured_then_frozen(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    loss = Perceptual("random", warmup=2)
    loss(picture(0), picture(1))
    loss(picture(0), picture(2))
    frozen = loss.layer_loss.clone()
    loss(picture(0), picture(0) * 0)
    assert torch.equal(loss.layer_loss, frozen)
    assert int(loss.calls) == 2
    resumed = Perceptual("random", warmup=2)  # the weights are in the checkpoint
    resumed.load_state_dict(loss.state_dict())
    assert torch.equal(resumed(picture(3), picture(4)), loss(picture(3), picture(4)))
    assert torch.equal(resumed.layer_loss, frozen)


def test_perceptual_asked_for_vgg_without_weights_says_where_to_put_them(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(DataError, match=FILES["vgg16"]):
        Perceptual("vgg16")
    with pytest.raises(ConfigError, match="vgg16, auto or random"):
        Perceptual("resnet")


def test_perceptual_reads_vgg_from_a_path(tmp_path):
    """A file with torchvision's layout, its convolutions random."""
    from torchvision.models.vgg import cfgs, make_layers

    torch.manual_seed(0)
    layers = make_layers(cfgs["D"]).state_dict()
    state = {f"features.{key}": value for key, value in layers.items()}
    torch.save(state | {"classifier.0.bias": torch.zeros(4096)}, tmp_path / FILES["vgg16"])
    loss = Perceptual("auto", path=str(tmp_path))
    assert torch.equal(loss.stages[0][0].weight, layers["0.weight"])
    assert loss.mark is None
    shapes = [tuple(f.shape[1:]) for f in loss.features(torch.rand(1, 3, 32, 32))]
    assert shapes == [(64, 32, 32), (128, 16, 16), (256, 8, 8), (512, 4, 4)]
    image = torch.rand(1, 3, 32, 32, requires_grad=True)
    loss(image, torch.rand(1, 3, 32, 32)).backward()
    assert float(image.grad.abs().max()) > 0


def test_weight_files_that_are_not_weights_are_refused(tmp_path):
    import pickle

    broken = tmp_path / FILES["vgg16"]
    broken.write_bytes(b"not a checkpoint")
    with pytest.raises(DataError, match="not a readable"):
        load_weights(broken)
    marker = tmp_path / "ran"

    class Malicious:
        def __reduce__(self):
            return (marker.write_text, ("code ran",))

    broken.write_bytes(pickle.dumps({"weight": Malicious()}))
    with pytest.raises(DataError, match="not a readable"):
        load_weights(broken)
    assert not marker.exists()
    with pytest.raises(DataError, match="no such file"):
        find_weights("vgg16", tmp_path / "nowhere")


def test_other_networks_weights_are_refused(tmp_path):
    path = tmp_path / FILES["vgg16"]
    torch.save({"features.0.weight": torch.zeros(1)}, path)
    with pytest.raises(DataError, match="VGG-16"):
        Perceptual("vgg16", path=str(path))
