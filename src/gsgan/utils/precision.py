"""Full precision for geometry, rasteriser and SSIM under autocast."""

from __future__ import annotations

import torch
from torch import Tensor


def full_precision(like: Tensor) -> torch.autocast:
    """Disables autocast on the device of ``like``: bf16 projections are off by pixels."""
    return torch.autocast(like.device.type, enabled=False)
