"""Scores of one picture or segmentation against the truth."""

import gsgan.compat  # noqa: F401  (before torchmetrics, which imports torchvision)
