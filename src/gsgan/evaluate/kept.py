"""The scores so far of a split, kept on disk so that an interrupted scoring goes on."""

import io
import time
from collections.abc import Mapping
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch

from gsgan.evaluate.scores import Tally
from gsgan.utils.files import write_atomically, writing

FOLDER = ".scoring"  # of the files, in the folder of the scores
KEEP_SECONDS = 60.0  # between two writes of a file


class KeptScores:
    """Keeps a split's scores while it is scored.

    Args:
        path: the file.
        key: what the scores depend on, as plain values; scores of another key are not used.
    """

    def __init__(self, path: Path, key: Mapping[str, Any]) -> None:
        self.path = path
        self.key = dict(key)
        self._written = time.monotonic()

    def restore(self, tally: Tally) -> None:
        """Gives a tally the scores of an interrupted scoring, if there are some."""
        # A file that cannot be read, or has scores of something else, is written again.
        try:
            state = torch.load(self.path, map_location="cpu", weights_only=True)
        except (OSError, RuntimeError, UnpicklingError, EOFError):
            return

        # Other settings would give other scores.
        if state["key"] == self.key:
            tally.load_state_dict(state["tally"])

    def keep(self, tally: Tally) -> None:
        """Writes the scores, if the last time was long ago."""
        # Once a minute is enough: an interruption then costs little.
        if time.monotonic() - self._written < KEEP_SECONDS:
            return

        # Packed in memory first, since the file is written completely or not at all.
        stream = io.BytesIO()
        torch.save({"key": self.key, "tally": tally.state_dict()}, stream)
        with writing(self.path):
            write_atomically(self.path, stream.getvalue())
        self._written = time.monotonic()
