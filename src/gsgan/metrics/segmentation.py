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
    """``[classes, classes]`` number of pixels by label ``[B, H, W]`` (rows) and by the class that S
    ``[B, classes, H, W]`` predicts (columns)."""
    classes = segmentation.shape[1]
    matrix = multiclass_confusion_matrix(
        segmentation.argmax(dim=1),
        labels,
        classes,
        ignore_index=IGNORE_LABEL,
    )
    return matrix.cpu()


def miou(matrix: Tensor) -> dict[str, float | None]:
    """Mean intersection over union of the ground truth's classes, without and with background.

    Args:
        matrix: from `confusion`; background is class 0.
    """
    # Intersection over union of each class that the ground truth has.
    matrix = matrix.double()
    truth = matrix.sum(1)
    intersection = matrix.diag()
    union = matrix.sum(0) + truth - intersection
    present = truth > 0
    iou = torch.where(present, intersection / union.clamp_min(1), torch.nan)

    # Means without and with the background.
    parts = iou[1:][present[1:]]
    classes = iou[present]
    return {
        "miou": float(parts.mean()) if len(parts) else None,
        "miou_with_background": float(classes.mean()) if len(classes) else None,
    }


def colour_labels(labels: Tensor) -> Tensor:
    """``[B, H, W]`` part labels as images ``[B, 3, H, W]``; unscored pixels are white."""
    # Classes beyond the palette repeat its colours, but not the background's.
    parts = len(PALETTE) - 1
    index = torch.where(labels == 0, 0, 1 + (labels - 1) % parts)
    image = PALETTE.to(labels.device)[index].float() / 255
    unscored = (labels == IGNORE_LABEL).unsqueeze(-1)
    return torch.where(unscored, 1.0, image).permute(0, 3, 1, 2)
