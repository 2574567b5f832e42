"""Finds and reads pretrained torchvision weights; nothing is downloaded."""

from __future__ import annotations

from pathlib import Path

import torch

from gsgan.utils.errors import DataError

FILES = {
    "vgg16": "vgg16-397923af.pth",
    "alexnet": "alexnet-owt-7be5be79.pth",
}


def find_weights(name: str, path: str | Path | None = None) -> Path | None:
    """The weight file of torchvision's ``vgg16`` or ``alexnet``, or None if there is none.

    Args:
        name: of the network.
        path: the file or its folder; None looks in the torch cache.

    Raises:
        DataError: when a path was given and the file does not exist.
    """
    if path is None:
        cached = Path(torch.hub.get_dir()) / "checkpoints" / FILES[name]
        return cached if cached.is_file() else None
    given = Path(path).expanduser()
    found = given / FILES[name] if given.is_dir() else given
    if not found.is_file():
        raise DataError(f"{found}: no such file; expected torchvision's {name} weights there")
    return found


def how_to_get(name: str) -> str:
    """How to install the weights, as a clause of a message."""
    return (
        f"put torchvision's {FILES[name]} into $TORCH_HOME/hub/checkpoints "
        "(~/.cache/torch/hub/checkpoints unless set) or give its path"
    )


def load_weights(path: Path) -> dict[str, torch.Tensor]:
    """Reads a state dict without unrestricted pickle.

    Raises:
        DataError: when the file is not a plain state dict.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise DataError(
            f"{path}: not a readable torchvision weight file ({type(error).__name__}); "
            "download it again"
        ) from error
    if not isinstance(state, dict):
        raise DataError(f"{path}: expected a state dict, got {type(state).__name__}")
    return state
