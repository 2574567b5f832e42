"""Scores of pictures and segmentations, and the evaluation that gathers them."""

import gsgan.compat  # noqa: F401  (before torchmetrics, which imports torchvision)
