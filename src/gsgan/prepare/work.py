"""The working folder: results of finished stages, found again when a run is repeated."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsgan.prepare.writing import writing
from gsgan.utils.errors import DataError

KEY_LENGTH = 12


def digest(content: Any) -> str:
    """A short name that changes when the plain values in ``content`` do."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


def _kept(path: Path) -> dict[str, np.ndarray] | None:
    """All arrays of an npz; None when it is missing or damaged: it is then made again."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception:  # zip, zlib, numpy and tokenize each raise what they like
        return None


@dataclass(frozen=True)
class Work:
    """A folder ``.<name>.prepare`` beside the dataset in the making.

    Args:
        folder: that one.
        used: names of this run's results, by stage.
    """

    folder: Path
    used: dict[str, str] = field(default_factory=dict)

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
        self.used[stage] = f"{stage}-{digest(key)}"
        return self.folder / self.used[stage]

    def arrays(
        self, stage: str, key: Any, make: Callable[[], dict[str, Any]]
    ) -> dict[str, np.ndarray]:
        """Arrays of an earlier run with the same key, or made and kept now.

        Raises:
            DataError: when the disk does not take them.
        """
        path = self.place(stage, key).with_suffix(".npz")
        if (kept := _kept(path)) is not None:
            return kept
        arrays = make()
        part = path.with_name(f".{path.name}.part")
        with writing(path):
            with part.open("wb") as stream:
                np.savez(stream, **arrays)
            os.replace(part, path)
        return {name: np.asarray(array) for name, array in arrays.items()}

    def forget_others(self) -> None:
        """Takes away what runs with other keys left of the stages that this run came by."""
        for left in list(self.folder.iterdir()):
            stem = left.name.removesuffix(".npz")
            if stem[: -KEY_LENGTH - 1] not in self.used or stem in self.used.values():
                continue
            if left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)

    def remove(self) -> None:
        """Takes the folder away."""
        shutil.rmtree(self.folder, ignore_errors=True)
