"""Scores of part segmentations, and part labels as colours."""

import torch
from torch import Tensor
from torchmetrics.functional.classification import multiclass_confusion_matrix

from gsgan.data.pixels import IGNORE_LABEL

# Background, then twelve body parts; further classes repeat them.
PALETTE = torch.tensor(
    [
        [0, 0, 0],
        [110, 70, 40],
        [240, 200, 170],
        [60, 120, 220],
        [50, 60, 110],
        [230, 120, 60],
        [250, 190, 60],
        [200, 50, 80],
        [250, 110, 150],
        [60, 160, 90],
        [140, 210, 110],
        [120, 80, 170],
        [190, 150, 230],
    ]
)


def confusion(segmentation: Tensor, labels: Tensor) -> Tensor:
    """``[classes, classes]`` pixels of S ``[B, classes, H, W]``, rows by labels ``[B, H, W]``."""
    return multiclass_confusion_matrix(
        segmentation.argmax(dim=1),
        labels,
        segmentation.shape[1],
        ignore_index=IGNORE_LABEL,
    ).cpu()


def miou(matrix: Tensor) -> dict[str, float | None]:
    """Mean intersection over union of the ground truth's classes, without and with background.

    Args:
        matrix: from `confusion`; background is class 0.
    """
    matrix = matrix.double()
    truth = matrix.sum(1)
    union = matrix.sum(0) + matrix.sum(1) - matrix.diag()
    present = truth > 0
    iou = torch.where(present, matrix.diag() / union.clamp_min(1), torch.nan)
    return {
        "miou": float(iou[1:][present[1:]].mean()) if present[1:].any() else None,
        "miou_with_background": float(iou[present].mean()) if present.any() else None,
    }


def colour_labels(labels: Tensor) -> Tensor:
    """``[B, H, W]`` part labels as images ``[B, 3, H, W]``; unscored pixels are white."""
    index = torch.where(labels == 0, 0, 1 + (labels - 1) % (len(PALETTE) - 1))
    image = PALETTE.to(labels.device)[index].float() / 255
    image = torch.where((labels == IGNORE_LABEL).unsqueeze(-1), 1.0, image)
    return image.permute(0, 3, 1, 2)
