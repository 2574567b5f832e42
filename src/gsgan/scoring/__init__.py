"""Runs and any method's predictions scored on a split: protocols applied, tables, files."""

import gsgan.compat  # noqa: F401  (before torchmetrics, which imports torchvision)
