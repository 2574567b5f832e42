"""Progress on the terminal, one bar a camera."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class Stopped(Exception):
    """Another camera failed, or the user interrupted: what is left of this one is not worth it."""


class Bars:
    """A bar for every camera, drawn on stderr while the block runs.

    Once ``stop`` is set, the next step of any camera ends it with `Stopped`.

    Args:
        what: goes on.
        names: of the cameras.
        total: steps of each, None when not known yet.
    """

    def __init__(self, what: str, names: Iterable[str], total: int | None = None) -> None:
        self.stop = threading.Event()
        columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
        console = Console(stderr=True)
        self._progress = Progress(
            *columns, TimeRemainingColumn(), console=console, transient=True,
            disable=not console.is_terminal,
        )  # fmt: skip
        self._tasks = {n: self._progress.add_task(f"{what}: {n}", total=total) for n in names}

    def __enter__(self) -> Bars:
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._progress.stop()

    def set(self, name: str, done: int, count: int) -> None:
        """So many of so many are done."""
        self._go_on()
        self._progress.update(self._tasks[name], completed=done, total=count)

    def advance(self, name: str) -> None:
        """One more is done."""
        self._go_on()
        self._progress.advance(self._tasks[name])

    def _go_on(self) -> None:
        if self.stop.is_set():
            raise Stopped
