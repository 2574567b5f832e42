"""Small constant tensors, made once for each device: copying one over would make the host wait."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor


def constant(values: Any, like: Tensor) -> Tensor:
    """The values, tuples of numbers, as a tensor of the dtype and device of ``like``; not to be
    written to."""
    return _constant(values, like.dtype, like.device)


@lru_cache(maxsize=1024)
def _constant(values: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # born in it, it could not be used for training later
        return torch.tensor(values, dtype=dtype, device=device)


def filled(values: Any, like: Tensor) -> Tensor:
    """`constant` for values that change from call to call: written on the device, number by
    number."""
    if isinstance(values, tuple):
        return torch.stack([filled(value, like) for value in values])
    return like.new_full((), values)
