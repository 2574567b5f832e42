"""LPIPS: never from random weights by itself; its arithmetic is torchmetrics'."""

import pytest
import torch
from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

from gsgan.data.metric_variants import MetricVariants
from gsgan.evaluate.run import lpips_name
from gsgan.evaluate.scores import image_scores
from gsgan.losses.perceptual import FILES
from gsgan.metrics.lpips import lpips
from gsgan.metrics.regions import mask_crop
from gsgan.utils.errors import ConfigError

RANGES = [(-1.0, 1.0), (0.0, 1.0)]


@pytest.fixture(scope="module")
def hub(tmp_path_factory):
    """A torch cache with a file laid out as torchvision's AlexNet, random where LPIPS looks."""
    from torchvision.models import alexnet

    torch.manual_seed(0)
    state = alexnet(weights=None).state_dict()
    for name, value in state.items():
        if name.startswith("classifier"):  # not looked at: stored as one number
            state[name] = torch.zeros(()).expand(value.shape)
    folder = tmp_path_factory.mktemp("hub")
    (folder / "checkpoints").mkdir()
    torch.save(state, folder / "checkpoints" / FILES["alexnet"])
    return folder


@pytest.fixture(scope="module")
def direct(hub):
    """torchmetrics' own LPIPS on the same numbers, one for each range it is fed."""
    before = torch.hub.get_dir()
    torch.hub.set_dir(hub)
    try:
        return {
            fed: LearnedPerceptualImagePatchSimilarity("alex", normalize=fed == RANGES[0]).eval()
            for fed in RANGES
        }
    finally:
        torch.hub.set_dir(before)


@pytest.fixture(scope="module")
def scores(hub):
    return {fed: lpips("alex", str(hub / "checkpoints"), fed)[0] for fed in RANGES}


@pytest.fixture(scope="module")
def pictures():
    generator = torch.Generator().manual_seed(1)
    a, b = (torch.rand(2, 3, 64, 64, generator=generator) for _ in range(2))
    return a, b


def test_lpips_without_weights_is_none_with_the_reason(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    score, reason = lpips("vgg")
    assert score is None
    assert FILES["vgg16"] in reason
    with pytest.raises(ConfigError, match="vgg or alex"):
        lpips("squeeze")


@pytest.mark.parametrize("fed", RANGES)
def test_lpips_is_torchmetrics_one_score_per_image(scores, direct, pictures, fed):
    a, b = pictures
    ours = scores[fed](a, b)
    assert ours.shape == (2,)
    with torch.no_grad():
        assert float(ours.mean()) == pytest.approx(float(direct[fed](a, b)), abs=1e-6)


def test_the_crop_is_what_the_backbone_sees(scores, direct, pictures):
    """Outside the mask's crop nothing counts; inside it is torchmetrics on the square."""
    image, target = (x[:1] for x in pictures)
    mask = torch.zeros(1, 1, 64, 64)
    mask[..., 60:63, 60:63] = 1  # with 50 px round it: rows and columns 10 to 63
    elsewhere = image.clone()
    elsewhere[..., :10, :] = 1 - elsewhere[..., :10, :]
    measures = MetricVariants(lpips_region="mask_crop_512", background="white")
    found = []
    for picture in (image, elsewhere):
        own = image_scores(picture, target, mask, measures=measures, lpips=scores[RANGES[0]])
        found.append(own["lpips"])
    crops = [mask_crop(x[0], mask[0], 1.0)[None].clamp(0, 1) for x in (image, target)]
    with torch.no_grad():
        assert found[0] == pytest.approx(float(direct[RANGES[0]](*crops)), abs=1e-6)
    assert found[0] == found[1]


def test_channels_are_fed_in_the_order_that_is_asked_for(scores, direct, pictures):
    image, target = (x[:1] for x in pictures)
    found = {}
    for order in ("rgb", "bgr"):
        measures = MetricVariants(lpips_channels=order)
        own = image_scores(image, target, measures=measures, lpips=scores[RANGES[0]])
        found[order] = own["lpips"]
    with torch.no_grad():
        swapped = float(direct[RANGES[0]](image[:, [2, 1, 0]], target[:, [2, 1, 0]]))
    assert found["bgr"] == pytest.approx(swapped, abs=1e-6)
    assert abs(found["bgr"] - found["rgb"]) > 1e-4


def test_the_name_says_backbone_range_and_region():
    assert lpips_name("vgg", MetricVariants()) == "LPIPS-VGG [-1,1]"
    crop = MetricVariants(lpips_range=(0, 1), lpips_region="mask_crop_512")
    assert lpips_name("vgg", MetricVariants(lpips_channels="bgr")) == "LPIPS-VGG [-1,1] BGR"
    assert lpips_name("alex", crop) == "LPIPS-Alex [0,1] mask crop 512"
