"""Small helpers for tensors: constants, precision, devices."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from gsgan.utils.errors import ConfigError


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


def full_precision(like: Tensor) -> torch.autocast:
    """Disables autocast on the device of ``like``: bf16 projections are off by pixels."""
    return torch.autocast(like.device.type, enabled=False)


def pick_device(name: str) -> torch.device:
    """The device of a name, checked to be usable.

    Args:
        name: ``auto`` (CUDA if available), ``cpu``, ``cuda`` or any other torch device.

    Raises:
        ConfigError: when it is not usable.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"device={name}: not usable here; try device=cpu") from error
