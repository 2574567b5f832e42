"""Which runs are meant: folders, sweeps and globs to runs, and those that had to stay out."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from gsgan.report.scored import Run, is_run, read_run
from gsgan.utils.errors import ConfigError, DataError


@dataclass(frozen=True)
class LeftOut:
    """A run folder that is in no table, and why."""

    folder: Path
    reason: str


def find_runs(given: Sequence[str]) -> list[Path]:
    """The run folders meant, each once, in the order given.

    Args:
        given: run folders, folders to search for them, globs of either.

    Raises:
        ConfigError: when one of them does not exist, or holds no run.
    """
    found: dict[Path, None] = {}
    for entry in given:
        if not entry.strip():
            raise ConfigError("runs: an entry is empty; give run folders, sweep folders or globs")
        runs = [run for folder in _expand(entry) for run in _inside(folder)]
        if not runs:
            raise ConfigError(
                f"runs: {entry} holds no run folder (none has metrics.json or .hydra/config.yaml)"
            )
        found |= dict.fromkeys(runs)
    return list(found)


def read_runs(folders: Sequence[Path]) -> tuple[list[Run], list[LeftOut]]:
    """The runs that can be read, and those that cannot, with the reason."""
    runs, out = [], []
    for folder in folders:
        try:
            runs.append(read_run(folder))
        except DataError as error:
            reason = str(error).removeprefix(f"{folder}: ").replace(f"{folder}{os.sep}", "")
            out.append(LeftOut(folder, reason))
    return runs, out


def _expand(entry: str) -> list[Path]:
    path = Path(entry).expanduser()
    if path.is_dir():
        return [path.resolve()]
    if path.exists():
        raise ConfigError(f"runs: {entry} is a file; give the run folder that it lies in")
    matches = sorted(glob.glob(str(path), recursive=True)) if glob.has_magic(entry) else []
    folders = [Path(match).resolve() for match in matches if Path(match).is_dir()]
    if not folders:
        what = "matches no folder" if glob.has_magic(entry) else "does not exist"
        raise ConfigError(f"runs: {entry} {what}; give run folders, sweep folders or globs")
    return folders


def _inside(folder: Path) -> Iterator[Path]:
    """The folder itself when it is a run, else the runs below it; a run holds no other."""
    if is_run(folder):
        yield folder
        return
    for at, below, _ in os.walk(folder):
        below[:] = sorted(name for name in below if not name.startswith("."))
        for name in list(below):
            if is_run(Path(at) / name):
                below.remove(name)
                yield Path(at) / name
