"""The console that commands print to."""

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from threading import Timer
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TimeRemainingColumn,
)

Item = TypeVar("Item")
MIN_WIDTH = 100  # columns: tables cut to the 80 of a log file cannot be read
LOG_SECONDS = 10.0  # between two lines of progress in a log file
SLOW_SECONDS = 2.0  # work that takes longer is named in a log file


def make_console() -> Console:
    """A console on stdout, at least 100 columns wide if that is a file."""
    console = Console()

    # A log file has no width of its own.
    if console.is_terminal:
        return console
    return Console(width=max(MIN_WIDTH, console.width))


class LoggedProgress(Progress):
    """Progress bars on a terminal; in a log file a line every `LOG_SECONDS` while work goes on."""

    def __init__(self, *columns: Any, **options: Any) -> None:
        super().__init__(*columns, **options)
        self._said = time.monotonic()

    def stop(self) -> None:
        """Ends the bars without rich's empty line in log files."""
        self.live.stop()

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Moves a task on, see `rich.progress.Progress`."""
        super().advance(task_id, advance)
        self._say(task_id)

    def update(self, task_id: TaskID, **changes: Any) -> None:
        """Changes a task, see `rich.progress.Progress`."""
        super().update(task_id, **changes)
        self._say(task_id)

    def _say(self, task_id: TaskID) -> None:
        # A terminal shows the bar itself.
        now = time.monotonic()
        if self.console.is_terminal or now - self._said < LOG_SECONDS:
            return
        self._said = now

        # The remaining time is not known at the start.
        task = self._tasks[task_id]
        left = task.time_remaining
        about = "" if left is None else f", about {left:.0f} s left"
        self.console.print(
            f"{task.description}: {task.completed:,.0f} of {task.total or 0:,.0f}{about}",
            markup=False,
            highlight=False,
        )


@contextmanager
def working(console: Console, what: str) -> Iterator[None]:
    """Says what is going on: a spinner on a terminal, a line in a log file if it takes long."""
    if console.is_terminal:
        with console.status(what):
            yield
        return

    # A log file gets the line only if the work takes long.
    say = Timer(
        SLOW_SECONDS, console.print, [f"{what} …"], {"highlight": False}
    )
    say.daemon = True
    say.start()
    try:
        yield
    finally:
        say.cancel()


def progress(console: Console, disable: bool = False) -> Progress:
    """Progress bars that disappear when done: title, bar, count, remaining time."""
    columns = (
        "{task.description}",
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    return LoggedProgress(
        *columns, console=console, transient=True, disable=disable
    )


def track(
    items: Iterable[Item],
    description: str,
    console: Console,
    total: int | None = None,
) -> Iterator[Item]:
    """The items one by one, with their number and the remaining time shown by `progress`."""
    with progress(console) as bars:
        yield from bars.track(items, total=total, description=description)
