"""Scores of an avatar on held-out cameras and held-out poses."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torchmetrics.classification import MulticlassConfusionMatrix

from gsgan.metrics.image import Score, edge_f1, high_frequencies, psnr, psnr_person, ssim
from gsgan.model.avatar import Avatar
from gsgan.model.segmentation import IGNORE
from gsgan.scene import Frame

PICTURE_METRICS = ("psnr", "psnr_person", "ssim", "lpips", "edge_f1", "high_frequencies")
METRICS = (*PICTURE_METRICS, "miou")
FLOOR = "floor"  # the all-background picture
VARIANTS = ("full", "splat", FLOOR)


@dataclass
class Mean:
    """A mean over pictures; infinite and undefined scores are counted, not averaged."""

    total: float = 0.0
    count: int = 0
    left_out: int = 0

    def update(self, scores: Tensor) -> None:
        for score in scores.double().tolist():
            if math.isfinite(score):
                self.total += score
                self.count += 1
            else:
                self.left_out += 1

    @property
    def value(self) -> float | None:
        return self.total / self.count if self.count else None


@dataclass
class PictureScores:
    """The scores of one variant's pictures, mean per image."""

    lpips: Score | None
    lpips_reason: str
    means: dict[str, Mean] = field(default_factory=dict)

    def update(self, image: Tensor, target: Tensor, mask: Tensor | None = None) -> None:
        """Adds pictures ``[B, 3, H, W]``; they are clamped to [0, 1] as they would be shown.

        Without a mask ``[B, 1, H, W]`` there is no score in the person's box.
        """
        image = image.clamp(0, 1)
        scores: dict[str, Score] = {
            "psnr": psnr,
            "ssim": ssim,
            "edge_f1": edge_f1,
            "high_frequencies": high_frequencies,
        }
        if self.lpips is not None:
            scores["lpips"] = self.lpips
        for name, score in scores.items():
            self.means.setdefault(name, Mean()).update(score(image, target))
        if mask is not None:
            person = psnr_person(image, target, mask)
            self.means.setdefault("psnr_person", Mean()).update(person)

    def compute(self) -> dict[str, Any]:
        """``{metric: value or None, metric_reason: …}``; scores left out are counted."""
        result: dict[str, Any] = {}
        for name in PICTURE_METRICS:
            mean = self.means.get(name, Mean())
            result[name] = mean.value
            if mean.left_out:
                result[f"{name}_left_out"] = mean.left_out
            if mean.value is None:
                no_score = "no picture had a finite score" if mean.left_out else "no picture"
                result[f"{name}_reason"] = self.lpips_reason if name == "lpips" else no_score
        return result


class SegmentationScores:
    """mIoU from one confusion matrix over the split, over the classes its truth contains."""

    def __init__(self, classes: int) -> None:
        # Only one process scores: waiting for the others, which have ended, would hang or fail.
        self.matrix = MulticlassConfusionMatrix(classes, ignore_index=IGNORE, sync_on_compute=False)

    def update(self, segmentation: Tensor, labels: Tensor) -> None:
        """Adds S ``[B, classes, H, W]`` against labels ``[B, H, W]``."""
        self.matrix.to(labels.device).update(segmentation.argmax(dim=1), labels)

    def compute(self) -> dict[str, Any]:
        """``miou`` (without background) and ``miou_with_background``."""
        matrix = self.matrix.compute().double().cpu()
        truth, union = matrix.sum(1), matrix.sum(0) + matrix.sum(1) - matrix.diag()
        present = truth > 0
        iou = torch.where(present, matrix.diag() / union.clamp_min(1), torch.nan)
        return {
            "miou": float(iou[1:][present[1:]].mean()) if present[1:].any() else None,
            "miou_with_background": float(iou[present].mean()) if present.any() else None,
        }


def evaluate_split(
    avatar: Avatar,
    frames: Iterable[Frame],
    *,
    lpips: Score | None,
    lpips_reason: str,
    marks: list[str],
) -> dict[str, dict[str, Any]]:
    """Scores every frame of a split.

    Args:
        avatar: in eval mode; frames are moved to its device.
        frames: batches of frames.
        lpips, lpips_reason: from `gsgan.metrics.image.lpips`.
        marks: notes that every table of this run must carry.

    Returns:
        ``{variant: {metric: value}}``: ``full`` is I_pred, ``splat`` Step I's colour, ``floor`` the
        all-background picture; a metric that cannot be had is None with ``<metric>_reason``.
    """
    pictures = {name: PictureScores(lpips, lpips_reason) for name in VARIANTS}
    parts: SegmentationScores | None = None
    reason = "the model has no segmentation"
    count = 0
    device = next(avatar.parameters()).device
    for frame in frames:
        frame = frame.to(device)
        with torch.no_grad():
            painting = avatar.paint(frame)
        assert painting.image is not None
        pictures["full"].update(painting.image, frame.image, frame.mask)
        if painting.colour is not None:
            pictures["splat"].update(painting.colour, frame.image, frame.mask)
        pictures[FLOOR].update(torch.zeros_like(frame.image), frame.image, frame.mask)
        if painting.segmentation is not None and frame.labels is None:
            reason = "the data has no part labels"
        elif painting.segmentation is not None and frame.labels is not None:
            parts = parts or SegmentationScores(painting.segmentation.shape[1])
            parts.update(painting.segmentation, frame.labels)
        count += len(frame)
    if avatar.splats is None:  # there is no Step I
        del pictures["splat"]
    result = {name: scores.compute() for name, scores in pictures.items()}
    result["full"] |= parts.compute() if parts else _none("miou", reason)
    if "splat" in result:
        result["splat"] |= _none("miou", "Step I's colour is not a segmentation")
    result[FLOOR] |= _none("miou", "an all-background picture is not a segmentation")
    for scores in result.values():
        scores["images"] = count
        scores["marks"] = list(marks)
    return result


def empty_split(reason: str, marks: list[str]) -> dict[str, dict[str, Any]]:
    """What a split without frames gets: every metric None, with the reason."""
    return {
        variant: {
            **{key: value for m in METRICS for key, value in _none(m, reason).items()},
            "images": 0,
            "marks": list(marks),
        }
        for variant in VARIANTS
    }


def _none(metric: str, reason: str) -> dict[str, Any]:
    return {metric: None, f"{metric}_reason": reason}
