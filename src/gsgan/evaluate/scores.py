"""The scores of many pictures and segmentations: a row a picture, and their means."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
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

PICTURE_METRICS = (
    *("psnr", "psnr_person", "ssim", "ssim_person", "lpips", "lpips_person"),
    *("edge_f1", "edge_f1_person", "edge_ratio", "edge_ratio_person", "high_frequencies"),
)
PART_METRICS = ("miou", "miou_with_background")
METRICS = (*PICTURE_METRICS, *PART_METRICS)
LPIPS_LEAST = 64  # pixels: AlexNet's last map is empty below
Place = tuple[str, int]  # camera name, frame number


@dataclass(frozen=True)
class Row:
    """One picture's scores; a metric that it cannot have is absent, an undefined one NaN."""

    camera: str
    frame: int
    scores: dict[str, float]


@dataclass
class Mean:
    """A mean over pictures; infinite and undefined scores are counted, not averaged."""

    total: float = 0.0
    count: int = 0
    left_out: int = 0

    def update(self, scores: Iterable[float]) -> None:
        for score in scores:
            if math.isfinite(score):
                self.total += score
                self.count += 1
            else:
                self.left_out += 1

    @property
    def value(self) -> float | None:
        return self.total / self.count if self.count else None


class PictureScores:
    """The scores of one variant's pictures.

    Args:
        lpips, lpips_reason: from `gsgan.metrics.lpips.lpips`.
        measures: which region, which ranges; pictures come as scored (`gsgan.evaluate.prepare`).
    """

    def __init__(
        self, lpips: Score | None, lpips_reason: str, measures: Measures | None = None
    ) -> None:
        self.lpips, self.lpips_reason = lpips, lpips_reason
        self.measures = measures or Measures()
        self.rows: list[Row] = []

    def update(
        self,
        image: Tensor,
        target: Tensor,
        mask: Tensor | None = None,
        box: Tensor | None = None,
        places: Sequence[Place] | None = None,
    ) -> None:
        """Adds pictures; they are clamped to [0, 1] as they would be shown.

        Args:
            image, target: ``[B, 3, H, W]``.
            mask: ``[B, 1, H, W]``; without it there is no score of the person alone.
            box: ``[B, 1, H, W]`` bool, the body's projected box, where the measures ask for it.
            places: camera and frame of each.
        """
        image = image.clamp(0, 1)
        scores = self._whole(image, target, box)
        scores["edge_f1"], scores["edge_ratio"] = edge_scores(image, target)
        scores["high_frequencies"] = high_frequencies(image, target)
        if mask is not None:
            scores["psnr_person"] = psnr_person(image, target, mask)
            scores["ssim_person"] = ssim_person(image, target, mask)
            inside = edge_scores(image, target, person_box(mask))
            scores["edge_f1_person"], scores["edge_ratio_person"] = inside
        if self.lpips is not None:
            scores["lpips"] = self._lpips(image, target, mask)
            if mask is not None:
                scores["lpips_person"] = self._lpips_person(image, target, mask)
        values = {name: score.double().tolist() for name, score in scores.items()}
        for i, (camera, frame) in enumerate(places or [("", 0)] * len(image)):
            row = {name: values[name][i] for name in PICTURE_METRICS if name in values}
            self.rows.append(Row(camera, frame, row))

    def _whole(self, image: Tensor, target: Tensor, box: Tensor | None) -> dict[str, Tensor]:
        """PSNR and SSIM of the region that the measures name."""
        pooling, value_range = self.measures.psnr_pooling, self.measures.ssim_range
        similarity = ssim_uniform if self.measures.ssim_window == "uniform" else ssim
        if self.measures.region != "body_box":
            return {
                "psnr": psnr(image, target, pooling=pooling),
                "ssim": similarity(image, target, value_range=value_range),
            }
        assert box is not None
        background = BACKGROUNDS[self.measures.background]
        pair = [cleared(picture, box, background) for picture in (image, target)]
        similar = []
        for i, where in enumerate(box):
            part = rectangle(where)
            if part is None:
                similar.append(image.new_tensor(torch.nan))
                continue
            a, b = (picture[i : i + 1, :, part[0], part[1]] for picture in pair)
            similar.append(similarity(a, b, value_range=value_range)[0])
        return {
            "psnr": psnr_where(image, target, box, pooling=pooling),
            "ssim": torch.stack(similar),
        }

    def _lpips(self, image: Tensor, target: Tensor, mask: Tensor | None) -> Tensor:
        assert self.lpips is not None
        if self.measures.lpips_channels == "bgr":
            image, target = image.flip(1), target.flip(1)
        if self.measures.lpips_region == "full":
            return self.lpips(image, target)
        assert mask is not None
        background, scores = BACKGROUNDS[self.measures.background], []
        for a, b, m in zip(image, target, mask, strict=True):
            crops = [mask_crop(picture, m, background) for picture in (a, b)]
            if crops[0] is None or crops[1] is None:
                scores.append(image.new_tensor(torch.nan))
            else:
                scores.append(self.lpips(crops[0][None], crops[1][None])[0])
        return torch.stack(scores)

    def _lpips_person(self, image: Tensor, target: Tensor, mask: Tensor) -> Tensor:
        """LPIPS of the person's box, made as large as the backbone needs; NaN without one."""
        assert self.lpips is not None
        if self.measures.lpips_channels == "bgr":
            image, target = image.flip(1), target.flip(1)
        scores = []
        for i, box in enumerate(person_box(mask)):
            part = rectangle(box, LPIPS_LEAST)
            if part is None:
                scores.append(image.new_tensor(torch.nan))
                continue
            a, b = (x[i : i + 1, :, part[0], part[1]] for x in (image, target))
            scores.append(self.lpips(a, b)[0])
        return torch.stack(scores)

    def compute(self) -> dict[str, Any]:
        """``{metric: value or None, metric_reason: …}``; scores left out are counted."""
        result: dict[str, Any] = {}
        for name in PICTURE_METRICS:
            mean = mean_of(self.rows, name)
            result[name] = mean.value
            if mean.left_out:
                result[f"{name}_left_out"] = mean.left_out
            if mean.value is None:
                no_score = "no picture had a finite score" if mean.left_out else "no picture"
                missing = self.lpips_reason if name.startswith("lpips") else ""
                result[f"{name}_reason"] = missing or no_score
        return result

    def by_camera(self) -> dict[str, dict[str, float | None]]:
        """The means of each camera's pictures."""
        cameras = dict.fromkeys(row.camera for row in self.rows)
        return {
            camera: {
                name: mean_of([r for r in self.rows if r.camera == camera], name).value
                for name in PICTURE_METRICS
            }
            for camera in cameras
        }


def mean_of(rows: Iterable[Row], name: str) -> Mean:
    """The mean of one metric over rows."""
    mean = Mean()
    mean.update(row.scores[name] for row in rows if name in row.scores)
    return mean


class SegmentationScores:
    """mIoU from one confusion matrix over the split, over the classes its truth contains."""

    def __init__(self, classes: int) -> None:
        self.classes = classes
        self.matrices: dict[str, Tensor] = {}  # by camera

    def update(
        self, segmentation: Tensor, labels: Tensor, places: Sequence[Place] | None = None
    ) -> list[dict[str, float | None]]:
        """Adds S ``[B, classes, H, W]`` against labels ``[B, H, W]``; returns each one's own."""
        own = []
        for i, (camera, _) in enumerate(places or [("", 0)] * len(labels)):
            matrix = multiclass_confusion_matrix(
                segmentation[i].argmax(dim=0), labels[i], self.classes, ignore_index=IGNORE
            ).cpu()
            self.matrices[camera] = self.matrices.get(camera, torch.zeros_like(matrix)) + matrix
            own.append(miou(matrix))
        return own

    def compute(self) -> dict[str, Any]:
        """``miou`` (without background) and ``miou_with_background``."""
        result: dict[str, Any] = miou(torch.stack(list(self.matrices.values())).sum(0))
        no_part = {f"{m}_reason": "the truth holds no part" for m in result if result[m] is None}
        return result | no_part

    def by_camera(self) -> dict[str, dict[str, float | None]]:
        """The same of each camera's pictures."""
        return {camera: miou(matrix) for camera, matrix in self.matrices.items()}


def miou(matrix: Tensor) -> dict[str, float | None]:
    """Mean intersection over union, without and with background, of the truth's classes.

    Args:
        matrix: ``[classes, classes]`` pixels, truth by row; background is class 0.
    """
    matrix = matrix.double()
    truth, union = matrix.sum(1), matrix.sum(0) + matrix.sum(1) - matrix.diag()
    present = truth > 0
    iou = torch.where(present, matrix.diag() / union.clamp_min(1), torch.nan)
    return {
        "miou": float(iou[1:][present[1:]].mean()) if present[1:].any() else None,
        "miou_with_background": float(iou[present].mean()) if present.any() else None,
    }
