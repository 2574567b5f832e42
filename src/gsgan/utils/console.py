"""The console that commands print to."""

from __future__ import annotations

from rich.console import Console

LEAST_WIDTH = 100  # columns: tables cut to the 80 of a log file cannot be read


def make_console() -> Console:
    """A console on stdout, at least 100 columns wide where that is a file."""
    console = Console()
    return console if console.is_terminal else Console(width=max(LEAST_WIDTH, console.width))
