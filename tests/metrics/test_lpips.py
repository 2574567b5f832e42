"""LPIPS: the original package's numbers, one score per image, regions and protocols' variants."""

import math

import pytest
import torch

from gsgan.data.metric_variants import MetricVariants
from gsgan.evaluate.scores import image_scores, lpips_input
from gsgan.metrics.lpips import LpipsAgainst, build_lpips
from gsgan.metrics.regions import mask_crop
from gsgan.utils.errors import ConfigError

pytestmark = pytest.mark.usefixtures("weights")

# What the package lpips 0.1.4 (version="0.1") gives for `pattern`, its blur, and a fainter copy:
# fed from -1 to 1, then unscaled from 0 to 1.
ORIGINAL = {
    ("vgg", "blur", (-1.0, 1.0)): 0.361613363,
    ("vgg", "faint", (-1.0, 1.0)): 0.00825733040,
    ("alex", "blur", (-1.0, 1.0)): 0.303895712,
    ("alex", "faint", (-1.0, 1.0)): 0.0161965974,
    ("vgg", "blur", (0.0, 1.0)): 0.367284745,
    ("vgg", "faint", (0.0, 1.0)): 0.0104712863,
    ("alex", "blur", (0.0, 1.0)): 0.288064092,
    ("alex", "faint", (0.0, 1.0)): 0.0194665790,
}
ALEX = {"lpips_alex", "lpips_alex_person"}


def pattern() -> torch.Tensor:
    """``[1, 3, 96, 128]``: waves of changing length, different in each channel."""
    y = torch.arange(96, dtype=torch.float64)[:, None]
    x = torch.arange(128, dtype=torch.float64)[None, :]
    red = torch.sin(x * y / 40)
    green = torch.cos((x - 64) ** 2 / 60 + y / 5)
    blue = torch.sin(x / 3) * torch.cos(y / 7)
    return (0.5 + 0.5 * torch.stack([red, green, blue]))[None].float()


def changed(image: torch.Tensor) -> dict[str, torch.Tensor]:
    blur = torch.nn.functional.avg_pool2d(
        image, 5, 1, 2, count_include_pad=False
    )
    return {"blur": blur, "faint": 0.7 * image + 0.1}


@pytest.fixture(scope="module")
def networks():
    return build_lpips(["vgg", "alex"])


@pytest.mark.parametrize(("net", "change", "fed"), ORIGINAL)
def test_the_original_packages_numbers(networks, net, change, fed):
    image = pattern()
    measures = MetricVariants(lpips_range=fed)
    scores = LpipsAgainst(image, None, networks, measures)(
        changed(image)[change]
    )
    assert set(scores) == {"lpips_vgg", "lpips_alex"}
    assert scores[f"lpips_{net}"] == pytest.approx(
        ORIGINAL[net, change, fed], rel=1e-4
    )


def test_torchmetrics_distance_of_the_same_networks(networks):
    """torchmetrics' own arithmetic, whose networks get the same numbers."""
    from torchmetrics.functional.image.lpips import _LPIPS

    theirs = _LPIPS(net="alex", pnet_rand=True).eval()
    convolutions = [
        m for m in theirs.net.modules() if isinstance(m, torch.nn.Conv2d)
    ]
    ours = [
        m
        for m in networks["alex"].network.modules()
        if isinstance(m, torch.nn.Conv2d)
    ]
    for mine, other in zip(ours, convolutions, strict=True):
        other.load_state_dict(mine.state_dict())
    a, b = torch.rand(2, 3, 64, 72), torch.rand(2, 3, 64, 72)
    with torch.no_grad():
        expected = theirs(a, b, normalize=True).flatten()
        torch.testing.assert_close(
            networks["alex"](a, b), expected, rtol=1e-5, atol=1e-7
        )


def test_equal_images_have_no_distance_and_a_black_one_is_finite(networks):
    image = torch.zeros(1, 3, 64, 64)
    scores = LpipsAgainst(image, None, networks)(image)
    assert scores == {"lpips_vgg": 0.0, "lpips_alex": 0.0}
    assert math.isfinite(
        LpipsAgainst(image, None, networks)(image + 1)["lpips_vgg"]
    )


@pytest.mark.parametrize("background", ["black", "white"])
@pytest.mark.parametrize(
    ("shown", "painted"),
    [
        ((40, 90, 50, 80), (44, 93, 40, 80)),  # rows and columns
        ((0, 20, 0, 30), (0, 20, 0, 30)),
        ((100, 131, 120, 149), (60, 131, 100, 149)),
        ((0, 131, 0, 149), (0, 131, 0, 149)),
        ((40, 90, 50, 80), None),
        (None, None),
    ],
)
def test_what_both_images_show_of_the_background_is_not_computed(
    networks, background, shown, painted
):
    """The scores are those of whole images, of odd sizes too."""
    generator = torch.Generator().manual_seed(0)
    grey = 0.0 if background == "black" else 1.0
    images = []
    for box in (painted, shown):
        image = torch.full((1, 3, 131, 149), grey)
        if box is not None:
            top, bottom, left, right = box
            part = image[..., top:bottom, left:right]
            part += torch.rand(part.shape, generator=generator) - grey
        images.append(image)
    image, target = images
    measures = MetricVariants(background=background)
    mask = torch.zeros(1, 1, 131, 149)
    mask[..., 30:100, 40:90] = 1
    scores = LpipsAgainst(target, mask, networks, measures)(image)
    for name, network in networks.items():
        with torch.no_grad():
            features = network.features(image), network.features(target)
            layers = network.layers(*features)
        whole = sum(float(layer.mean()) for layer in layers)
        assert scores[f"lpips_{name}"] == pytest.approx(whole, abs=1e-6)
        enlarged = sum(
            torch.nn.functional.interpolate(x, (131, 149), mode="bilinear")
            for x in layers
        )
        inside = float(enlarged[..., 30:100, 40:90].mean())
        assert scores[f"lpips_{name}_person"] == pytest.approx(inside, abs=1e-6)


def test_the_gradient_of_a_black_image_is_finite(networks):
    image = torch.zeros(1, 3, 64, 64, requires_grad=True)
    networks["alex"](image, torch.ones(1, 3, 64, 64)).sum().backward()
    assert torch.isfinite(image.grad).all()
    assert image.grad.abs().max() > 0


def test_the_persons_box_has_the_errors_near_it_alone(networks):
    target = pattern()
    mask = torch.zeros(1, 1, 96, 128)
    mask[..., 10:90, 4:30] = 1
    near, far = target.clone(), target.clone()
    near[..., 40:60, 10:24] = 0.5
    far[..., 40:60, 110:124] = 0.5
    scores = LpipsAgainst(target, mask, {"alex": networks["alex"]})
    assert set(scores(near)) == ALEX
    assert (
        scores(near)["lpips_alex_person"]
        > 10 * scores(far)["lpips_alex_person"]
    )
    assert scores(near)["lpips_alex_person"] > 2 * scores(near)["lpips_alex"]
    assert scores(far)["lpips_alex"] > 0.005
    nobody = LpipsAgainst(
        target, torch.zeros_like(mask), {"alex": networks["alex"]}
    )(near)
    assert math.isnan(nobody["lpips_alex_person"])
    assert math.isfinite(nobody["lpips_alex"])


def test_a_box_as_large_as_the_image_has_nearly_its_score(networks):
    """Not the same: the coarse layers are enlarged before the mean is taken."""
    image = pattern()
    whole = torch.ones(1, 1, 96, 128)
    scores = LpipsAgainst(image, whole, networks)(changed(image)["blur"])
    for net in networks:
        assert scores[f"lpips_{net}_person"] == pytest.approx(
            scores[f"lpips_{net}"], rel=1e-3
        )


def test_the_crop_is_what_the_network_sees(networks):
    """Outside the mask's crop nothing counts; inside, it is LPIPS of the square."""
    target = pattern()[..., :64, :64]
    image = changed(target)["blur"]
    mask = torch.zeros(1, 1, 64, 64)
    mask[..., 60:63, 60:63] = (
        1  # with 50 px round it: rows and columns 10 to 63
    )
    elsewhere = image.clone()
    elsewhere[..., :10, :] = 1 - elsewhere[..., :10, :]
    measures = MetricVariants(lpips_region="mask_crop_512", background="white")
    only = {"alex": networks["alex"]}
    found = []
    for predicted in (image, elsewhere):
        lpips = LpipsAgainst(target, mask, only, measures)
        own = image_scores(
            predicted, target, mask, measures=measures, lpips=lpips
        )
        found.append(own["lpips_alex"])
    squares = [mask_crop(x[0], mask[0], 1.0)[None] for x in (image, target)]
    with torch.no_grad():
        assert found[0] == pytest.approx(
            float(networks["alex"](*squares)), abs=1e-6
        )
    assert found[0] == found[1]
    nobody = LpipsAgainst(target, torch.zeros_like(mask), only, measures)(image)
    assert math.isnan(nobody["lpips_alex"])


def test_channels_are_fed_in_the_requested_order(networks):
    target = pattern()
    image = target.clone()
    image[:, 0] = 0.5  # red alone
    found = {}
    for order in ("rgb", "bgr"):
        measures = MetricVariants(lpips_channels=order)
        found[order] = LpipsAgainst(target, None, networks, measures)(image)[
            "lpips_alex"
        ]
    with torch.no_grad():
        swapped = float(networks["alex"](image.flip(1), target.flip(1)))
    assert found["bgr"] == pytest.approx(swapped, abs=1e-6)
    assert abs(found["bgr"] - found["rgb"]) > 1e-3


def test_what_the_networks_get_is_described():
    assert lpips_input(MetricVariants()) == "[-1,1]"
    assert lpips_input(MetricVariants(lpips_channels="bgr")) == "[-1,1] BGR"
    crop = MetricVariants(lpips_range=(0, 1), lpips_region="mask_crop_512")
    assert lpips_input(crop) == "[0,1] mask crop 512"


def test_images_too_small_for_the_networks_are_refused(networks):
    image = torch.zeros(1, 3, 31, 64)
    with pytest.raises(ConfigError, match=r"at least 32 pixels.*64 × 31"):
        LpipsAgainst(image, None, networks)
    assert LpipsAgainst(image, None, {})(image) == {}


def test_unknown_networks_are_refused_and_none_leaves_lpips_out():
    with pytest.raises(ConfigError, match=r"lpips\.nets.*vgg, alex"):
        build_lpips(["squeeze"])
    assert build_lpips([]) == {}
