"""The console that commands print to."""

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

LEAST_WIDTH = 100  # columns: tables cut to the 80 of a log file cannot be read


def make_console() -> Console:
    """A console on stdout, at least 100 columns wide where that is a file."""
    console = Console()
    return (
        console
        if console.is_terminal
        else Console(width=max(LEAST_WIDTH, console.width))
    )


def progress(console: Console, disable: bool = False) -> Progress:
    """Progress bars that disappear when done: title, bar, count, remaining time."""
    columns = (
        "{task.description}",
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, transient=True, disable=disable)
