"""The training scheme: one LightningModule, schedules, callbacks."""

import gsgan.compat  # noqa: F401  (before lightning, which imports torchvision)
