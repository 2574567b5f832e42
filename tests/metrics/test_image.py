"""Scores of pictures: closed forms, and torchmetrics called directly."""

import math

import cv2
import numpy as np
import pytest
import torch
from torchmetrics.image import (
    PeakSignalNoiseRatio,
    StructuralSimilarityIndexMeasure,
)

from gsgan.metrics.image import (
    edge_f1,
    edge_scores,
    flicker,
    high_frequencies,
    person_box,
    psnr,
    psnr_inside,
    psnr_where,
    ssim,
    ssim_map,
    ssim_uniform,
    ssim_where,
)


def square(at: int, size: int = 40) -> torch.Tensor:
    image = torch.zeros(1, 3, size, size)
    image[..., at : at + 12, at : at + 12] = 1.0
    return image


def pair(count: int = 3, size: int = 32) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shape = (count, 3, size, size + 5)
    target = torch.rand(shape, generator=generator, dtype=torch.float64)
    noise = torch.randn(shape, generator=generator, dtype=torch.float64)
    scale = torch.tensor([0.02, 0.1, 0.5], dtype=torch.float64)[:count].view(
        -1, 1, 1, 1
    )
    return (target + scale * noise).clamp(0, 1), target


def test_psnr_closed_form_and_one_score_per_image():
    target = torch.zeros(2, 3, 8, 8)
    image = torch.stack(
        [torch.full((3, 8, 8), 0.1), torch.full((3, 8, 8), 0.01)]
    )
    torch.testing.assert_close(psnr(image, target), torch.tensor([20.0, 40.0]))


def test_psnr_pooled_by_channel_is_the_mean_of_their_psnrs():
    image = (
        torch.tensor([0.1, 0.01, 0.001], dtype=torch.float64)
        .view(1, 3, 1, 1)
        .expand(1, 3, 8, 8)
    )
    target = torch.zeros_like(image)
    assert float(psnr(image, target, pooling="channels")) == pytest.approx(
        40.0, abs=1e-9
    )
    together = -10 * math.log10((1e-2 + 1e-4 + 1e-6) / 3)
    assert float(psnr(image, target)) == pytest.approx(together, abs=1e-9)


def test_psnr_is_torchmetrics_mean_per_image():
    image, target = pair()
    metric = PeakSignalNoiseRatio(data_range=1.0, dim=(1, 2, 3)).double()
    assert float(psnr(image, target).mean()) == pytest.approx(
        float(metric(image, target)), abs=1e-6
    )
    pooled = PeakSignalNoiseRatio(data_range=1.0).double()
    assert (
        abs(float(pooled(image, target)) - float(psnr(image, target).mean()))
        > 1
    )


@pytest.mark.parametrize("value_range", [1.0, 2.0])
def test_ssim_is_torchmetrics(value_range):
    image, target = pair()
    metric = StructuralSimilarityIndexMeasure(data_range=value_range).double()
    ours = float(ssim(image, target, value_range=value_range).mean())
    assert ours == pytest.approx(float(metric(image, target)), abs=1e-6)


def test_ssim_of_equal_images_is_one_and_of_slivers_undefined():
    image = torch.rand(3, 3, 16, 16)
    torch.testing.assert_close(ssim(image, image), torch.ones(3))
    assert float(ssim(image, 1 - image).max()) < 0.5
    assert bool(ssim(image[..., :5], image[..., :5]).isnan().all())
    assert float(ssim(image[..., :6], image[..., :6]).min()) == 1.0


@pytest.mark.parametrize("value_range", [1.0, 2.0])
def test_uniform_ssim_is_its_definition_window_by_window(value_range):
    """Wang et al. with a 7 x 7 box and sample covariances, as scikit-image's documents say."""
    image, target = (x[:2, :, :9, :10] for x in pair())
    c1, c2 = (0.01 * value_range) ** 2, (0.03 * value_range) ** 2
    scores = []
    for a, b in zip(image.numpy(), target.numpy(), strict=True):
        windows = []
        for c, i, j in np.ndindex(3, 3, 4):
            x, y = (v[c, i : i + 7, j : j + 7].ravel() for v in (a, b))
            (xx, xy), (_, yy) = np.cov(x, y)  # divides by 48
            top = (2 * x.mean() * y.mean() + c1) * (2 * xy + c2)
            windows.append(
                top / ((x.mean() ** 2 + y.mean() ** 2 + c1) * (xx + yy + c2))
            )
        scores.append(np.mean(windows))
    found = ssim_uniform(image, target, value_range=value_range)
    assert found.tolist() == pytest.approx(scores, abs=1e-9)


def test_the_persons_box_leaves_the_background_out():
    target, mask = torch.zeros(1, 3, 20, 20), torch.zeros(1, 1, 20, 20)
    mask[..., 5:15, 8:12] = 1.0
    image = target.clone()
    image[..., 5:15, 8:12] = 0.1
    box = person_box(mask)
    torch.testing.assert_close(
        psnr_where(image, target, box), torch.tensor([20.0])
    )
    # 40 of 400 pixels
    assert float(psnr(image, target)) == pytest.approx(20 + 10 * math.log10(10))


def test_the_outline_is_left_out():
    target, mask = torch.zeros(2, 3, 20, 20), torch.zeros(2, 1, 20, 20)
    mask[0, :, 5:17, 5:17] = 1.0
    image = target.clone()
    image[..., 5:7, :] = 0.5  # within two pixels of the outline
    image[..., 8:14, 8:14] = 0.1  # not
    error = 0.1**2 * 36 / 64  # 8 × 8 pixels of the box are left
    assert float(psnr_inside(image, target, mask)[0]) == pytest.approx(
        -10 * math.log10(error)
    )
    assert math.isnan(float(psnr_inside(image, target, mask)[1]))


def test_the_persons_box_is_filled_between_its_ends():
    mask = torch.zeros(1, 1, 9, 9)
    mask[0, 0, 2, 3], mask[0, 0, 6, 5], mask[0, 0, 0, 0] = 1.0, 0.5, 0.49
    box = torch.zeros(1, 1, 9, 9, dtype=torch.bool)
    box[..., 2:7, 3:6] = True
    assert torch.equal(person_box(mask), box)


def test_ssim_of_chosen_pixels_is_its_map_there():
    image, target = pair(1)
    where = torch.zeros(1, 1, *image.shape[-2:], dtype=torch.bool)
    where[..., 8:20, 10:22] = True
    _, full = StructuralSimilarityIndexMeasure(
        data_range=1.0, return_full_image=True
    ).double()(image, target)
    expected = float(full[..., 8:20, 10:22].mean())
    similar = ssim_map(image, target)
    inside = ssim_where(similar, where)
    nowhere = ssim_where(similar, torch.zeros_like(where))
    assert float(inside) == pytest.approx(expected, abs=1e-6)
    assert math.isnan(float(nowhere))


def test_high_frequencies_of_known_waves():
    x = torch.arange(32.0)
    slow, fast = (torch.cos(2 * math.pi * f * x) for f in (0.125, 0.375))

    def picture(a: float, b: float) -> torch.Tensor:
        return (a * slow + b * fast).expand(1, 3, 32, 32)

    share = high_frequencies(
        picture(1.0, 0.5), picture(0.3, 1.0)
    )  # energies 0.25 of 1
    torch.testing.assert_close(share, torch.tensor([0.25], dtype=torch.float64))
    assert float(
        high_frequencies(picture(2.0, 1.0), picture(1.0, 1.0))
    ) == pytest.approx(1.0)
    assert math.isnan(float(high_frequencies(picture(0, 0), picture(0, 0))))


def test_edge_f1_tolerates_one_pixel_only():
    truth = square(10)
    assert float(edge_f1(truth, truth)) == 1.0
    assert float(edge_f1(square(11), truth)) > 0.9
    assert float(edge_f1(square(14), truth)) < 0.5
    assert float(edge_f1(torch.zeros_like(truth), truth)) == 0.0
    assert math.isnan(float(edge_f1(truth, torch.zeros_like(truth))))


def test_edge_ratio_counts_opencvs_edge_pixels():
    truth = square(10)
    two = torch.maximum(square(2), square(22))
    assert float(edge_scores(truth, truth)[1]) == 1.0
    assert float(edge_scores(two, truth)[1]) == pytest.approx(2.0, abs=1e-9)
    assert float(edge_scores(torch.zeros_like(truth), truth)[1]) == 0.0
    assert math.isnan(float(edge_scores(truth, torch.zeros_like(truth))[1]))
    image, target = (x.float() for x in pair(1))
    grey = [
        cv2.cvtColor(
            (x[0] * 255).round().byte().permute(1, 2, 0).numpy(),
            cv2.COLOR_RGB2GRAY,
        )
        for x in (image, target)
    ]
    counts = [int(np.count_nonzero(cv2.Canny(g, 100, 200))) for g in grey]
    assert float(edge_scores(image, target)[1]) == pytest.approx(
        counts[0] / counts[1], abs=1e-9
    )


def test_edges_in_the_persons_box_leave_out_those_elsewhere():
    image, target = square(6), square(6)
    image[..., 26:34, 26:34] = (
        1.0  # an edge that the truth lacks, outside the box
    )
    where = torch.zeros(1, 1, 40, 40, dtype=torch.bool)
    where[..., 4:20, 4:20] = True
    f1, ratio = edge_scores(image, target, where)
    assert float(f1) == float(ratio) == 1.0
    assert float(edge_f1(image, target)) < 0.9
    assert float(edge_scores(image, target)[1]) > 1.3
    f1, ratio = edge_scores(image, target, torch.zeros_like(where))
    assert math.isnan(float(f1))
    assert math.isnan(float(ratio))


def test_an_edge_at_the_boxs_border_may_match_one_just_outside():
    image, target = square(6), square(7)  # one pixel off, within the tolerance
    where = torch.zeros(1, 1, 40, 40, dtype=torch.bool)
    where[..., 7:19, 7:19] = True
    assert float(edge_scores(image, target, where)[0]) == 1.0


def test_flicker_is_the_change_of_the_error_in_the_box_of_both_frames():
    mask, later = (square(at)[:, :1] for at in (8, 12))
    truth = square(8), square(12)
    shifted = (
        truth[0] + 0.1,
        truth[1] + 0.1,
    )  # an error that stays does not flicker
    assert (
        float(
            flicker(shifted[1], truth[1], later, (shifted[0], truth[0], mask))
        )
        < 1e-6
    )
    image = (
        truth[1] + 0.2 * mask * later
    )  # in 8 x 8 of the 16 x 16 pixels round both
    found = float(flicker(image, truth[1], later, (truth[0], truth[0], mask)))
    assert found == pytest.approx(0.2 * 64 / 256, abs=1e-6)
    empty = torch.zeros_like(mask)
    assert math.isnan(
        float(flicker(image, truth[1], empty, (truth[0], truth[0], empty)))
    )
