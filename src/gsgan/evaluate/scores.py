"""Scores of one image or segmentation, and means of many."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor
from torchmetrics.functional.classification import multiclass_confusion_matrix

from gsgan.data.measures import Measures
from gsgan.metrics.image import (
    Score,
    edge_scores,
    high_frequencies,
    person_box,
    psnr,
    psnr_person,
    psnr_where,
    ssim,
    ssim_person,
    ssim_uniform,
)
from gsgan.metrics.regions import BACKGROUNDS, cleared, mask_crop, rectangle
from gsgan.model.segmentation import IGNORE

IMAGE_METRICS = (
    *("psnr", "psnr_person", "ssim", "ssim_person", "lpips", "lpips_person"),
    *("edge_f1", "edge_f1_person", "edge_ratio", "edge_ratio_person", "high_frequencies"),
)
PART_METRICS = ("miou", "miou_with_background")
METRICS = (*IMAGE_METRICS, *PART_METRICS)
LPIPS_LEAST = 64  # pixels: AlexNet's last map is empty below


def image_scores(
    image: Tensor,
    target: Tensor,
    mask: Tensor | None = None,
    box: Tensor | None = None,
    *,
    measures: Measures | None = None,
    lpips: Score | None = None,
) -> dict[str, float]:
    """The scores of one image, clamped to [0, 1].

    Args:
        image, target: ``[1, 3, H, W]``, prepared (`gsgan.evaluate.prepare`).
        mask: ``[1, 1, H, W]`` of the person; required for the metrics of the person alone.
        box: ``[1, 1, H, W]`` bool, the body's projected box; required where the measures use it.
        measures: regions and ranges; None takes the defaults.
        lpips: from `gsgan.metrics.lpips.lpips`.

    Returns:
        ``{metric: score}``; a metric that was not computed is absent, an undefined one NaN.
    """
    measures, image = measures or Measures(), image.clamp(0, 1)
    pooling, background = measures.psnr_pooling, BACKGROUNDS[measures.background]

    def similarity(a: Tensor, b: Tensor) -> Tensor:
        score = ssim_uniform if measures.ssim_window == "uniform" else ssim
        return score(a, b, value_range=measures.ssim_range)

    scores: dict[str, Any] = {"high_frequencies": high_frequencies(image, target)}
    if measures.region == "body_box":
        assert box is not None
        scores["psnr"] = psnr_where(image, target, box, pooling=pooling)
        a, b = (cleared(x, box, background) for x in (image, target))
        scores["ssim"] = _inside(box, similarity, a, b)
    else:
        scores["psnr"] = psnr(image, target, pooling=pooling)
        scores["ssim"] = similarity(image, target)
    scores["edge_f1"], scores["edge_ratio"] = edge_scores(image, target)
    if mask is not None:
        person = person_box(mask)
        scores["psnr_person"] = psnr_person(image, target, mask)
        scores["ssim_person"] = ssim_person(image, target, mask)
        scores["edge_f1_person"], scores["edge_ratio_person"] = edge_scores(image, target, person)
    if lpips is not None:
        if measures.lpips_channels == "bgr":
            image, target = image.flip(1), target.flip(1)
        if mask is not None:
            scores["lpips_person"] = _inside(person, lpips, image, target, LPIPS_LEAST)
        if measures.lpips_region == "full":
            scores["lpips"] = lpips(image, target)
        else:
            assert mask is not None
            crops = [mask_crop(x[0], mask[0], background) for x in (image, target)]
            found = [crop[None] for crop in crops if crop is not None]
            scores["lpips"] = lpips(*found) if len(found) == 2 else math.nan
    return {metric: float(scores[metric]) for metric in IMAGE_METRICS if metric in scores}


def _inside(box: Tensor, score: Score, a: Tensor, b: Tensor, least: int = 1) -> Tensor | float:
    """The score of a box's rectangle, at least ``least`` pixels wide; NaN for an empty box."""
    part = rectangle(box[0], least)
    return math.nan if part is None else score(*(x[:, :, part[0], part[1]] for x in (a, b)))


def mean(rows: Iterable[Mapping[str, Any]], metric: str) -> tuple[float | None, int]:
    """The mean of the finite scores, None without one, and the number of scores left out."""
    scores = [row[metric] for row in rows if metric in row]
    finite = [score for score in scores if math.isfinite(score)]
    return (sum(finite) / len(finite) if finite else None), len(scores) - len(finite)


def means(rows: Iterable[Mapping[str, Any]], lpips_reason: str = "") -> dict[str, Any]:
    """``{metric: mean or None, metric_left_out: number, metric_reason: why None}`` of images.

    Args:
        rows: from `image_scores`.
        lpips_reason: why there is no LPIPS.
    """
    rows = list(rows)
    result: dict[str, Any] = {}
    for metric in IMAGE_METRICS:
        result[metric], left_out = mean(rows, metric)
        if left_out:
            result[f"{metric}_left_out"] = left_out
        if result[metric] is None:
            no_score = "no picture had a finite score" if left_out else "no picture"
            missing = lpips_reason if metric.startswith("lpips") else ""
            result[f"{metric}_reason"] = missing or no_score
    return result


def confusion(segmentation: Tensor, labels: Tensor) -> Tensor:
    """``[classes, classes]`` pixels of S ``[B, classes, H, W]``, rows by labels ``[B, H, W]``."""
    return multiclass_confusion_matrix(
        segmentation.argmax(dim=1), labels, segmentation.shape[1], ignore_index=IGNORE
    ).cpu()


def miou(matrix: Tensor) -> dict[str, float | None]:
    """Mean intersection over union of the ground truth's classes, without and with background.

    Args:
        matrix: from `confusion`; background is class 0.
    """
    matrix = matrix.double()
    truth, union = matrix.sum(1), matrix.sum(0) + matrix.sum(1) - matrix.diag()
    present = truth > 0
    iou = torch.where(present, matrix.diag() / union.clamp_min(1), torch.nan)
    return {
        "miou": float(iou[1:][present[1:]].mean()) if present[1:].any() else None,
        "miou_with_background": float(iou[present].mean()) if present.any() else None,
    }
