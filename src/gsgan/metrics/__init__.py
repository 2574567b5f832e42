"""Scores of images against the ground truth."""

import gsgan.utils.compat  # noqa: F401  (before torchmetrics, which imports torchvision)
