"""The working folder: results of finished stages, found again when a run is repeated."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsgan.data.files import read_arrays
from gsgan.errors import DataError

KEY_LENGTH = 12


def digest(content: Any) -> str:
    """A short name that changes when the plain values in ``content`` do."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


@dataclass(frozen=True)
class Work:
    """A folder ``.<name>.prepare`` beside the dataset in the making."""

    folder: Path

    @classmethod
    def beside(cls, out: Path) -> Work:
        """The working folder of a dataset, made if need be.

        Raises:
            DataError: when it cannot be made.
        """
        folder = out.parent / f".{out.name}.prepare"
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DataError(
                f"{folder} cannot be made ({error.strerror}); choose another out"
            ) from None
        return cls(folder)

    def place(self, stage: str, key: Any) -> Path:
        """Where a stage's result lies: its name says what it was made from."""
        return self.folder / f"{stage}-{digest(key)}"

    def arrays(
        self, stage: str, key: Any, make: Callable[[], dict[str, Any]]
    ) -> dict[str, np.ndarray]:
        """Arrays of an earlier run with the same key, or made and kept now."""
        path = self.place(stage, key).with_suffix(".npz")
        if not path.is_file():
            arrays = make()
            part = path.with_name(f".{path.name}.part")
            with part.open("wb") as stream:
                np.savez(stream, **arrays)
            os.replace(part, path)
        with np.load(path, allow_pickle=False) as archive:
            names = list(archive.files)
        return read_arrays(path, names)

    def forget(self, stage: str) -> None:
        """Takes away what earlier runs with other keys left of a stage."""
        for left in self.folder.glob(f"{stage}-*"):
            shutil.rmtree(left, ignore_errors=True)

    def remove(self) -> None:
        """Takes the folder away."""
        shutil.rmtree(self.folder, ignore_errors=True)
