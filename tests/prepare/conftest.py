"""A prepared dataset is checked by its own tests, and once in test_prepare_run.py."""

from pathlib import Path

import pytest
from rich.console import Console


@pytest.fixture(autouse=True)
def check(monkeypatch):
    """Leaves the check at the end out; gives the function that makes it."""
    from gsgan.check.run import check_capture

    def found_nothing(_root: Path, page: Path, _console: Console) -> None:
        page.with_suffix(".json").write_text('{"findings": []}')

    monkeypatch.setattr("gsgan.prepare.run.check_capture", found_nothing)
    return check_capture
