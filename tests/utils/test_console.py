"""Long work is named and counted in log files, where no bar can move."""

import io
import time

from rich.console import Console

from gsgan.utils import console as consoles
from gsgan.utils.console import progress, working


def logged(run) -> str:
    """What ``run`` prints to a console that is no terminal."""
    file = io.StringIO()
    run(Console(file=file, width=100))
    return file.getvalue()


def test_progress_is_counted_in_a_log_file(monkeypatch):
    monkeypatch.setattr(consoles, "LOG_SECONDS", 0.0)

    def run(console):
        with progress(console) as bars:
            task = bars.add_task("masks", total=3)
            bars.advance(task)
            bars.advance(task)

    lines = logged(run).splitlines()
    counted = [line.partition(",")[0] for line in lines]
    assert counted == ["masks: 1 of 3", "masks: 2 of 3"]


def test_quick_work_leaves_a_log_file_empty():
    def run(console):
        with working(console, "reading"), progress(console) as bars:
            assert list(bars.track(range(3))) == [0, 1, 2]

    assert logged(run) == ""


def test_slow_work_is_named_in_a_log_file(monkeypatch):
    monkeypatch.setattr(consoles, "SLOW_SECONDS", 0.01)

    def run(console):
        with working(console, "reading the data"):
            time.sleep(0.3)

    assert logged(run).strip() == "reading the data …"
