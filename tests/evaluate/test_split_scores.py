"""Means, reasons, cameras; regions of a protocol; mIoU against torchmetrics."""

import math
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from frames import frame_of
from torchmetrics.classification import MulticlassJaccardIndex

from gsgan.body.smpl_names import CLOTHES
from gsgan.data.metric_variants import MetricVariants
from gsgan.evaluate.predictions import Prediction, Preparation
from gsgan.evaluate.scores import (
    Scorer,
    confusion,
    image_scores,
    make_predictor,
    means,
    miou,
    over_poses,
    score_split,
)
from gsgan.metrics.image import psnr, ssim, ssim_uniform
from gsgan.metrics.names import FLOOR_VARIANT, FULL, SPLAT
from gsgan.model.rendering import Rendering
from gsgan.scene import Frame
from gsgan.utils.errors import GsganError


def person(size: int = 24) -> Frame:
    """A grey person of 8 x 8 pixels on black, her last column half covered."""
    mask = torch.zeros(1, 1, size, size)
    mask[..., 8:16, 8:15], mask[..., 8:16, 15] = 1.0, 0.5
    return frame_of(0.4 * mask.expand(1, 3, -1, -1), mask)


def scorer(measures: MetricVariants | None = None) -> Scorer:
    return Scorer(Preparation(measures or MetricVariants(), None))


def test_equal_images_are_kept_out_of_the_mean():
    rows = [{"psnr": score} for score in (math.inf, 30.0, 20.0, math.nan)]
    found = means(rows)
    assert (found["psnr"], found["psnr_left_out"]) == (25.0, 2)
    assert found["lpips_vgg"] is None
    assert found["lpips_vgg_reason"] == "left out by lpips.nets"
    assert "lpips_vgg_left_out" not in found


def test_means_by_camera_and_over_all():
    f = person()
    errors = {("a", 0): 0.1, ("a", 1): 0.01, ("b", 0): 0.001}

    def predict(f: Frame, item: tuple[str, int]) -> Prediction:
        return Prediction({FULL: f.image + errors[item]}, {})

    scores = score_split(
        [(item, f) for item in errors], predict, scorer()
    ).variants[FULL]
    assert scores["psnr"] == pytest.approx(40.0, abs=1e-3)
    assert scores["images"] == 3
    cameras = scores["cameras"]
    assert [cameras[c]["psnr"] for c in "ab"] == pytest.approx(
        [30.0, 60.0], abs=1e-3
    )


def test_poses_differ_by_the_deviation_of_their_own_means():
    rows = [
        {"frame": 0, "psnr": 20.0, "ssim": 0.5},
        {"frame": 0, "psnr": 22.0},
        {"frame": 1, "psnr": 25.0},
        {"frame": 1, "psnr": math.inf},
        {"frame": 2, "psnr": math.nan, "miou": None},
    ]
    # means of 21 and 25 dB; one pose alone has no deviation
    assert over_poses(rows) == {"psnr_over_poses": pytest.approx(8**0.5)}
    assert over_poses([{"frame": 0, "psnr": 1.0}]) == {}


def test_only_the_inside_of_the_box_counts_where_a_protocol_says_so():
    generator = torch.Generator().manual_seed(0)
    image, target = (
        torch.rand(1, 3, 24, 24, generator=generator) for _ in range(2)
    )
    box = torch.zeros(1, 1, 24, 24, dtype=torch.bool)
    box[..., 4:14, 6:20] = True
    measures = MetricVariants(region="body_box")
    result = image_scores(image, target, box=box, measures=measures)
    part = (..., slice(4, 14), slice(6, 20))
    assert result["psnr"] == pytest.approx(
        float(psnr(image[part], target[part])), abs=1e-5
    )
    assert result["ssim"] == pytest.approx(
        float(ssim(image[part], target[part])), abs=1e-6
    )
    unseen = image_scores(
        image, target, box=torch.zeros_like(box), measures=measures
    )
    both = means([result, unseen])  # unseen: counted, not averaged
    assert both["psnr_left_out"] == both["ssim_left_out"] == 1
    assert both["psnr"] == result["psnr"]


def test_the_window_of_ssim_is_the_protocols():
    generator = torch.Generator().manual_seed(0)
    image, target = (
        torch.rand(1, 3, 24, 24, generator=generator) for _ in range(2)
    )
    found = image_scores(
        image,
        target,
        measures=MetricVariants(ssim_window="uniform", ssim_range=2),
    )
    expected = float(ssim_uniform(image, target, value_range=2))
    assert found["ssim"] == pytest.approx(expected, abs=1e-9)
    assert abs(expected - float(ssim(image, target, value_range=2))) > 1e-4


def test_the_floor_of_a_split_is_the_background_and_its_psnr_is_known():
    """Black: 8 * 7.25 pixels' worth of 0.4² of 576. White: 0.6² inside, 0.3² where half covered."""
    f = person()
    for background, power in (
        ("black", 56 * 0.4**2 + 8 * 0.2**2),
        ("white", 56 * 0.6**2 + 8 * 0.3**2),
    ):
        found = score_split(
            [(("a", 0), f)],
            lambda f, _: Prediction({FULL: f.image}, {FULL: f.mask}),
            scorer(MetricVariants(background=background)),
        )
        assert found.variants[FLOOR_VARIANT]["psnr"] == pytest.approx(
            -10 * math.log10(power / 576), abs=1e-4
        )
        # equal: its own alpha puts it on white too
        assert found.variants[FULL]["psnr"] is None
        assert found.rows[FULL][0]["psnr"] == math.inf


def test_each_image_of_an_avatar_is_put_on_white_by_its_own_alpha():
    """I_pred is the truth; Step I's colour is it at half the alpha: 0.3 off, 0.15 at the edge."""
    f = person()
    rendering = Rendering(
        f.image, f.mask, features=0.5 * f.image, splat_alpha=0.5 * f.mask
    )
    avatar = Mock(return_value=rendering, segmentation=None)
    white = scorer(MetricVariants(background="white"))
    found = score_split([(("a", 0), f)], make_predictor(avatar), white)
    assert found.rows[FULL][0]["psnr"] == math.inf
    assert found.variants[SPLAT]["psnr"] == pytest.approx(
        -10 * math.log10((56 * 0.3**2 + 8 * 0.15**2) / 576), abs=1e-4
    )


def test_flicker_needs_consecutive_frames_of_one_camera_and_window():
    f, noise = person(), 0.1 * torch.ones(1, 3, 24, 24)
    moved = replace(f, camera=replace(f.camera, K=2 * f.camera.K))
    items = [
        (("a", 0), f),
        (("a", 1), f),
        (("a", 3), f),
        (("b", 4), f),
        (("b", 5), moved),
    ]
    predict = Mock(
        side_effect=[
            Prediction({FULL: f.image + i % 2 * noise}, {}) for i in range(5)
        ]
    )
    found = score_split(items, predict, scorer())
    assert ["flicker" in row for row in found.rows[FULL]] == [
        False,
        True,
        False,
        False,
        False,
    ]
    # rounded to 8 bits; the ground truth stands still, so the warped form is the same
    assert found.variants[FULL]["flicker"] == pytest.approx(0.1, abs=1e-2)
    assert found.variants[FULL]["warped_flicker"] == pytest.approx(
        0.1, abs=1e-2
    )
    assert (
        found.variants[FLOOR_VARIANT]["flicker"] == 0
    )  # the ground truth stands still
    alone = score_split(
        items[:1], lambda f, _: Prediction({FULL: f.image}, {}), scorer()
    )
    assert "consecutive" in alone.variants[FULL]["flicker_reason"]
    assert "consecutive" in alone.variants[FULL]["warped_flicker_reason"]


def test_shares_of_trunk_and_limbs_need_labels_with_names():
    size = 40
    mask = torch.zeros(1, 1, size, size)
    mask[..., 10:30, 10:30] = 1
    labels = CLOTHES.index("left_leg") * mask[:, 0].long()
    labels[:, :20] = CLOTHES.index("hair") * mask[:, 0, :20].long()
    f = frame_of(0.4 * mask.expand(1, 3, -1, -1), mask, labels=labels)
    image = f.image.clone()
    image[..., 24, 14:24] += 0.2
    found = {}
    for names in (CLOTHES, ()):
        prepare = Preparation(MetricVariants(), None, label_names=names)
        split = score_split(
            [(("a", 0), f)],
            lambda f, _: Prediction({FULL: image}, {}),
            Scorer(prepare),
        )
        found[names] = split.variants[FULL]
    assert found[CLOTHES]["area_trunk"] == found[CLOTHES]["area_limbs"] > 0.2
    assert found[CLOTHES]["error_limbs"] == pytest.approx(1)
    assert found[()]["error_limbs"] is None
    assert "no part labels" in found[()]["error_limbs_reason"]
    assert found[()]["error_outline"] == 0


def test_an_image_that_is_not_finite_is_an_error_that_names_it():
    f = person()
    broken = f.image.clone()
    broken[0, 0, 3, 3] = torch.nan
    with pytest.raises(GsganError, match=r"camera a, frame 0.* 1 "):
        score_split(
            [(("a", 0), f)],
            lambda f, _: Prediction({FULL: broken}, {}),
            scorer(),
        )


def segmentation(predicted: torch.Tensor, classes: int) -> torch.Tensor:
    return (
        torch.nn.functional.one_hot(predicted, classes)
        .float()
        .permute(0, 3, 1, 2)
    )


def test_miou_counts_classes_of_the_truth_only():
    """Class 1 half right, class 2 absent from the truth but predicted once, 255 ignored."""
    labels = torch.tensor([[[0, 0, 1, 1, 255]]])
    result = miou(
        confusion(segmentation(torch.tensor([[[0, 2, 1, 0, 1]]]), 3), labels)
    )
    assert result["miou"] == pytest.approx(
        1 / 2
    )  # class 1: 1 of {2 true, 1 predicted}
    assert result["miou_with_background"] == pytest.approx((1 / 3 + 1 / 2) / 2)


def test_miou_is_torchmetrics_jaccard_index_over_the_split():
    generator = torch.Generator().manual_seed(0)
    predicted, labels = (
        torch.randint(0, 4, (3, 9, 9), generator=generator) for _ in range(2)
    )
    labels[:, 0] = 255
    maps = segmentation(predicted, 4)
    f = frame_of(torch.zeros(1, 3, 9, 9), torch.zeros(1, 1, 9, 9))
    frames = [
        (("ab"[i > 0], i), replace(f, labels=labels[i : i + 1]))
        for i in range(3)
    ]
    found = score_split(
        frames,
        lambda f, item: Prediction(
            {FULL: f.image}, {}, segmentation=maps[item[1]][None]
        ),
        scorer(),
    )
    whole = found.variants[FULL]

    def jaccard(images: slice) -> torch.Tensor:
        each = MulticlassJaccardIndex(4, average=None, ignore_index=255)
        return each(predicted[images], labels[images])

    assert whole["miou"] == pytest.approx(
        float(jaccard(slice(3))[1:].mean()), abs=1e-6
    )
    assert whole["miou_with_background"] == pytest.approx(
        float(jaccard(slice(3)).mean()), abs=1e-6
    )
    first = pytest.approx(float(jaccard(slice(1))[1:].mean()), abs=1e-6)
    assert whole["cameras"]["a"]["miou"] == found.rows[FULL][0]["miou"] == first


def test_miou_of_a_split_without_parts_is_none():
    f = replace(person(), labels=torch.zeros(1, 24, 24, dtype=torch.long))
    parts = segmentation(f.labels, 3)
    found = score_split(
        [(("a", 0), f)],
        lambda f, _: Prediction({FULL: f.image}, {}, segmentation=parts),
        scorer(),
    )
    assert found.variants[FULL]["miou"] is None
    assert found.variants[FULL]["miou_reason"] == "the ground truth has no part"
