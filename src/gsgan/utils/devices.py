"""The device of a command."""

from __future__ import annotations

import torch

from gsgan.utils.errors import ConfigError


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
