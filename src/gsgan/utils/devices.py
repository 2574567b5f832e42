"""Which device a command runs on."""

from __future__ import annotations

import torch

from gsgan.utils.errors import ConfigError


def pick_device(name: str) -> torch.device:
    """The device of that name; ``auto`` takes CUDA where there is one.

    Args:
        name: ``auto``, ``cpu``, ``cuda`` or any other torch device.

    Returns:
        A device that tensors can be made on.

    Raises:
        ConfigError: when it cannot be used here.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.empty(0, device=name).device
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"device={name}: not usable here; try device=cpu") from error
