"""Checkpoints that are whole or not there."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO

from gsgan.utils.files import write_atomically


class AtomicCheckpoints(TorchCheckpointIO):
    """Writes beside the old checkpoint and renames: a kill leaves the old one or the new one.

    Lightning's own writer goes through the system's temporary folder; from another file system that
    is a copy, which a kill can cut off.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None
    ) -> None:
        """Saves a checkpoint to a local path."""
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        write_atomically(Path(path), buffer.getvalue())
