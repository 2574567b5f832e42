"""Scores of one picture or segmentation against the truth."""

import gsgan.utils.compat  # noqa: F401  (before torchmetrics, which imports torchvision)
