"""The working folder of a run, parallel work with progress bars, safe writing of the dataset."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console

from gsgan.data.formats.capture import read_capture
from gsgan.utils.console import progress
from gsgan.utils.errors import DataError
from gsgan.utils.files import write_npz, writing

T = TypeVar("T")
Advance = Callable[[int, int], None]  # takes the number of steps done and in total
GENERATOR = "gsgan.prepare"
KEY_LENGTH = 12


def each_camera(
    task: Callable[[str, Advance], T], what: str, names: Sequence[str], workers: int
) -> dict[str, T]:
    """Runs ``task(camera, advance)`` per camera in threads, with one progress bar each on stderr.

    The first failure or an interrupt is raised; tasks that have not started are cancelled, and
    running ones are stopped at their next ``advance``, as a thread cannot be ended from outside.
    """
    stop, console = threading.Event(), Console(stderr=True)
    bars = progress(console, disable=not console.is_terminal)

    def run(name: str) -> T:
        row = bars.add_task(f"{what}: {name}", total=None)

        def advance(done: int, count: int) -> None:
            if stop.is_set():
                raise CancelledError
            bars.update(row, completed=done, total=count)

        return task(name, advance)

    with bars, ThreadPoolExecutor(workers) as pool:
        futures = {name: pool.submit(run, name) for name in names}
        try:
            return {name: future.result() for name, future in futures.items()}
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise


def digest(content: Any) -> str:
    """A short name that changes when the plain values in ``content`` do."""
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:KEY_LENGTH]


class Work:
    """A folder with the results of finished stages; it is created when missing."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.used: dict[str, str] = {}  # names of this run's results, by stage
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)

    def place(self, stage: str, key: Any) -> Path:
        """Path of a stage's result; its name contains a digest of its inputs."""
        self.used[stage] = f"{stage}-{digest(key)}"
        return self.folder / self.used[stage]

    def arrays(
        self, stage: str, key: Any, make: Callable[[], dict[str, Any]]
    ) -> dict[str, np.ndarray]:
        """Arrays of an earlier run with the same key, or made and stored now."""
        path = self.place(stage, key).with_suffix(".npz")
        try:
            with np.load(path, allow_pickle=False) as archive:
                return dict(archive)
        except Exception:  # missing or damaged: zip, zlib, numpy and tokenize have their own errors
            pass
        arrays = make()
        write_npz(path, **arrays)
        return {name: np.asarray(array) for name, array in arrays.items()}

    def forget_others(self) -> None:
        """Removes results with other keys of the stages that this run used."""
        for left in list(self.folder.iterdir()):
            stem = left.name.removesuffix(".npz")
            if self.used.get(stem[: -KEY_LENGTH - 1], stem) == stem:
                continue
            if left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)


def is_there(out: Path, key: str, overwrite: bool) -> bool:
    """Whether ``out`` holds the dataset with this key.

    Raises:
        DataError: when it holds something else and may not be overwritten.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return False
    made_by: Any = None
    with contextlib.suppress(OSError, ValueError, AttributeError):
        made_by = json.loads((out / "meta.json").read_text()).get("made_by")
    if not isinstance(made_by, dict) or made_by.get("generator") != GENERATOR:
        raise DataError(f"{out} holds something else; choose another out")
    if made_by.get("key") != key and not overwrite:
        raise DataError(f"{out} was made with other settings; add overwrite=true")
    return bool(made_by.get("key") == key)


def publish(root: Path, out: Path) -> None:
    """Moves the finished dataset ``root`` to ``out``; an old one is removed when that is done.

    Raises:
        DataError: when training could not read it, or it cannot be moved.
    """
    try:
        read_capture(root)
    except DataError as error:
        raise DataError(f"nothing was made, because training could not read it: {error}") from None
    old = out.with_name(f".{out.name}.old")
    with writing(out):
        if out.exists():
            shutil.rmtree(old, ignore_errors=True)
            os.replace(out, old)
        os.replace(root, out)
    shutil.rmtree(old, ignore_errors=True)
