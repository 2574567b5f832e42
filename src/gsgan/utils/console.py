"""The console that runs print to."""

from __future__ import annotations

from rich.console import Console

LEAST_WIDTH = 100  # columns: a table cut to a log file's default 80 cannot be read


def make_console() -> Console:
    """The terminal; where output goes to a file, lines of at least 100 columns."""
    console = Console()
    return console if console.is_terminal else Console(width=max(LEAST_WIDTH, console.width))
