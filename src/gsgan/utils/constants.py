"""Small constant tensors, made once per device: copying them each time would synchronise."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor


def constant(values: Any, like: Tensor) -> Tensor:
    """Nested tuples of numbers as a tensor with the dtype and device of ``like``; read only."""
    return _constant(values, like.dtype, like.device)


@lru_cache(maxsize=1024)
def _constant(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # an inference tensor could not be used in training later
        return torch.tensor(values, dtype=dtype, device=device)


def filled(values: Any, like: Tensor) -> Tensor:
    """Like `constant` for values that change between calls: filled on the device, not copied."""
    if isinstance(values, tuple):
        return torch.stack([filled(value, like) for value in values])
    return like.new_full((), values)
