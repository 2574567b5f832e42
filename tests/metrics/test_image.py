"""Scores: closed forms, and the cases in which a mean would lie."""

from __future__ import annotations

import math

import pytest
import torch

from gsgan.errors import ConfigError
from gsgan.losses.weights import FILES
from gsgan.metrics.evaluation import Mean, PictureScores, SegmentationScores
from gsgan.metrics.image import edge_f1, high_frequencies, lpips, psnr, psnr_person, ssim


def square(at: int, size: int = 40) -> torch.Tensor:
    image = torch.zeros(1, 3, size, size)
    image[..., at : at + 12, at : at + 12] = 1.0
    return image


def test_psnr_closed_form_and_one_score_a_picture():
    target = torch.zeros(2, 3, 8, 8)
    image = torch.stack([torch.full((3, 8, 8), 0.1), torch.full((3, 8, 8), 0.01)])
    torch.testing.assert_close(psnr(image, target), torch.tensor([20.0, 40.0]))


def test_equal_pictures_are_infinite_and_kept_out_of_the_mean():
    image = torch.rand(1, 3, 16, 16)
    assert math.isinf(float(psnr(image, image)))
    mean = Mean()
    mean.update(torch.tensor([math.inf, 30.0, 20.0, math.nan]))
    assert mean.value == 25.0
    assert (mean.count, mean.left_out) == (2, 2)
    assert Mean().value is None


def test_the_persons_box_leaves_the_background_out():
    target, mask = torch.zeros(1, 3, 20, 20), torch.zeros(1, 1, 20, 20)
    mask[..., 5:15, 8:12] = 1.0
    image = target.clone()
    image[..., 5:15, 8:12] = 0.1
    torch.testing.assert_close(psnr_person(image, target, mask), torch.tensor([20.0]))
    assert float(psnr(image, target)) == pytest.approx(20 + 10 * math.log10(10))  # 40 of 400 pixels
    assert math.isnan(float(psnr_person(image, target, torch.zeros_like(mask))))


def test_high_frequencies_of_known_waves():
    x = torch.arange(32.0)
    slow, fast = (torch.cos(2 * math.pi * f * x) for f in (0.125, 0.375))

    def picture(a: float, b: float) -> torch.Tensor:
        return (a * slow + b * fast).expand(1, 3, 32, 32)

    share = high_frequencies(picture(1.0, 0.5), picture(0.3, 1.0))  # energies 0.25 of 1
    torch.testing.assert_close(share, torch.tensor([0.25], dtype=torch.float64))
    assert float(high_frequencies(picture(2.0, 1.0), picture(1.0, 1.0))) == pytest.approx(1.0)
    assert math.isnan(float(high_frequencies(picture(0, 0), picture(0, 0))))


def test_ssim_of_equal_pictures_is_one():
    image = torch.rand(3, 3, 16, 16)
    torch.testing.assert_close(ssim(image, image), torch.ones(3))
    assert float(ssim(image, 1 - image).max()) < 0.5


def test_edge_f1_tolerates_one_pixel_only():
    truth = square(10)
    assert float(edge_f1(truth, truth)) == 1.0
    assert float(edge_f1(square(11), truth)) > 0.9
    assert float(edge_f1(square(14), truth)) < 0.5
    assert float(edge_f1(torch.zeros_like(truth), truth)) == 0.0
    assert math.isnan(float(edge_f1(truth, torch.zeros_like(truth))))


def test_lpips_without_weights_is_none_with_the_reason(monkeypatch, tmp_path):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    score, reason = lpips("vgg")
    assert score is None
    assert FILES["vgg16"] in reason
    with pytest.raises(ConfigError, match="vgg or alex"):
        lpips("squeeze")


def test_picture_scores_name_a_reason_for_every_none():
    scores = PictureScores(None, "no weights")
    image = torch.zeros(1, 3, 16, 16)
    scores.update(image, image)  # PSNR infinite, no edges
    result = scores.compute()
    assert result["psnr"] is None
    assert result["psnr_left_out"] == 1
    assert "finite" in result["psnr_reason"]
    assert result["lpips_reason"] == "no weights"
    assert result["ssim"] == pytest.approx(1.0)


def test_miou_counts_classes_of_the_truth_only():
    """Class 1 half right, class 2 absent from the truth but predicted once, 255 ignored."""
    labels = torch.tensor([[[0, 0, 1, 1, 255]]])
    predicted = torch.tensor([[0, 2, 1, 0, 1]])
    S = torch.nn.functional.one_hot(predicted, 3).float().permute(2, 0, 1).unsqueeze(0)
    scores = SegmentationScores(3)
    scores.update(S, labels)
    result = scores.compute()
    assert result["miou"] == pytest.approx(1 / 2)  # class 1: 1 of {2 true, 1 predicted}
    assert result["miou_with_background"] == pytest.approx((1 / 3 + 1 / 2) / 2)


def test_miou_of_a_split_without_parts_is_none():
    scores = SegmentationScores(3)
    S = torch.zeros(1, 3, 1, 2)
    S[:, 0] = 1
    scores.update(S, torch.zeros(1, 1, 2, dtype=torch.long))
    assert scores.compute()["miou"] is None
