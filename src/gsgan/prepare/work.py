"""The working folder of a run, parallel work with progress bars, and safe writing of files."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gsgan.utils.errors import DataError
from gsgan.utils.files import write_atomically

T = TypeVar("T")
KEY_LENGTH = 12


class Stopped(Exception):
    """Another camera failed, or the user interrupted, so this one ends as well."""


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns a failure of the disk (full, read-only, not allowed) into a `DataError` with ``path``.

    Raises:
        DataError: naming ``path``.
    """
    try:
        yield
    except OSError as error:
        raise DataError(f"{path} cannot be written ({error.strerror or error})") from None


def write_npz(path: Path, **arrays: Any) -> None:
    """Writes an npz completely or not at all."""
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    with writing(path):
        write_atomically(path, stream.getvalue())


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a JSON file completely or not at all; NaN becomes null."""
    with writing(path):
        write_atomically(path, json.dumps(_plain(content), indent=1) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def progress(console: Console, disable: bool = False) -> Progress:
    """Progress bars that disappear when done: title, bar, count, remaining time."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    return Progress(
        *columns, TimeRemainingColumn(), console=console, transient=True, disable=disable
    )


def each_camera(
    task: Callable[[str, Callable[[int, int], None]], T],
    what: str,
    names: Sequence[str],
    workers: int,
) -> dict[str, T]:
    """Runs a task per camera in threads, with one progress bar each on stderr.

    The first failure or an interrupt is raised; tasks that have not started are cancelled, and
    running ones are stopped at their next report, as a thread cannot be ended from outside.

    Args:
        task: called with the camera's name and a function that takes the number of steps done and
            in total.
        what: title of the bars.
        names: of the cameras.
        workers: tasks at once.
    """
    stop, console = threading.Event(), Console(stderr=True)
    bars = progress(console, disable=not console.is_terminal)
    rows = {name: bars.add_task(f"{what}: {name}", total=None) for name in names}

    def run(name: str) -> T:
        def report(done: int, count: int) -> None:
            if stop.is_set():
                raise Stopped
            bars.update(rows[name], completed=done, total=count)

        return task(name, report)

    with bars, ThreadPoolExecutor(workers) as pool:
        futures = {name: pool.submit(run, name) for name in names}
        try:
            return {name: future.result() for name, future in futures.items()}
        except BaseException:
            stop.set()
            for future in futures.values():
                future.cancel()
            raise


def digest(content: Any) -> str:
    """A short name that changes when the plain values in ``content`` do."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


@dataclass(frozen=True)
class Work:
    """A folder ``.<name>.prepare`` beside the dataset, with the results of finished stages.

    Args:
        folder: the working folder.
        used: names of this run's results, by stage.
    """

    folder: Path
    used: dict[str, str] = field(default_factory=dict)

    @classmethod
    def beside(cls, out: Path) -> Work:
        """The working folder of a dataset; it is created when missing.

        Raises:
            DataError: when it cannot be created.
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
        """Path of a stage's result; its name contains a digest of its inputs."""
        self.used[stage] = f"{stage}-{digest(key)}"
        return self.folder / self.used[stage]

    def arrays(
        self, stage: str, key: Any, make: Callable[[], dict[str, Any]]
    ) -> dict[str, np.ndarray]:
        """Arrays of an earlier run with the same key, or made and stored now.

        Raises:
            DataError: when they cannot be written.
        """
        path = self.place(stage, key).with_suffix(".npz")
        try:
            with np.load(path, allow_pickle=False) as archive:
                return {name: archive[name] for name in archive.files}
        except Exception:  # missing or damaged: zip, zlib, numpy and tokenize have their own errors
            pass
        arrays = make()
        part = path.with_name(f".{path.name}.part")
        with writing(path):
            with part.open("wb") as stream:
                np.savez(stream, **arrays)
            os.replace(part, path)
        return {name: np.asarray(array) for name, array in arrays.items()}

    def forget_others(self) -> None:
        """Removes results with other keys of the stages that this run used."""
        for left in list(self.folder.iterdir()):
            stem = left.name.removesuffix(".npz")
            if stem[: -KEY_LENGTH - 1] not in self.used or stem in self.used.values():
                continue
            if left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)

    def remove(self) -> None:
        """Removes the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)
