"""Results of finished stages on disk, and work on all cameras at once with progress bars."""

import hashlib
import json
import shutil
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console

from gsgan.utils.console import progress
from gsgan.utils.files import writing

Result = TypeVar("Result")
# takes the number of steps done and in total
Advance = Callable[[int, int], None]
KEY_LENGTH = 12


def each_camera(
    task: Callable[[str, Advance], Result],
    what: str,
    names: Sequence[str],
    workers: int,
) -> dict[str, Result]:
    """Runs ``task(camera, advance)`` per camera in threads, with one progress bar each on stderr.

    The first failure or an interrupt is raised; tasks that have not started are cancelled, and
    running ones are stopped at their next ``advance``, as a thread cannot be ended from outside.
    """
    stop = threading.Event()
    console = Console(stderr=True)
    bars = progress(console, disable=not console.is_terminal)

    # A task reports its progress by `advance`, where it can also be stopped.
    def run(name: str) -> Result:
        row = bars.add_task(f"{what}: {name}", total=None)

        def advance(done: int, count: int) -> None:
            if stop.is_set():
                raise CancelledError
            bars.update(row, completed=done, total=count)

        return task(name, advance)

    # The results are in the order of the names.
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


class StageFolder:
    """A folder with the results of finished stages; it is created when missing."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.used: dict[str, str] = {}  # names of this run's results, by stage
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)

    def path(self, stage: str, key: Any) -> Path:
        """Path of a stage's result; its name contains a digest of its inputs."""
        self.used[stage] = f"{stage}-{digest(key)}"
        return self.folder / self.used[stage]

    def remove_others(self) -> None:
        """Removes results with other keys of the stages that this run used."""
        for left in list(self.folder.iterdir()):
            stem = left.name.removesuffix(".npz")
            stage = stem[: -KEY_LENGTH - 1]
            if self.used.get(stage, stem) == stem:
                continue
            if left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)
