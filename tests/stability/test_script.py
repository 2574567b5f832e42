"""``make stability``: its tables, its exit."""

from __future__ import annotations

import importlib.util
import json
import math
import sys
from pathlib import Path

import pytest

from stability.cases.case import Row

SCRIPT = Path(__file__).parents[2] / "scripts" / "stability.py"


def row(case: str, backend: str, status="right", error=1e-6, expected=None, note="") -> Row:
    numbers = (error, 2 * error, "means")
    return Row(case, "scenes", backend, *numbers, status, expected or status, note)


ROWS = [
    row("needle", "torch"),
    row("needle", "native", "finite only", 3e-2),
    row("needle", "reference", error=math.inf),
    row("mirror", "-", "refused", math.nan, note="det -1"),
]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs the script on given rows; the folder that it writes."""
    spec = importlib.util.spec_from_file_location("stability_script", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    def go(rows, *options):
        folder = tmp_path / "out"
        monkeypatch.setattr(script, "compare_all", lambda device: iter(rows))
        monkeypatch.setattr(sys, "argv", ["stability.py", "--out", str(folder), *options])
        script.main()
        return folder

    return go


def test_every_row_is_written_and_nan_is_null(run, capsys):
    folder = run(ROWS)
    records = json.loads((folder / "stability.json").read_text())["rows"]
    assert [r["value_error"] for r in records] == [1e-6, 3e-2, None, None]
    assert (folder / "stability.csv").read_text().count("\n") == 5
    page = (folder / "stability.md").read_text()
    for text in (page, capsys.readouterr().out):
        assert "| needle | scenes | native | 0.030 | 0.060 | means | finite only |  |" in text
        assert "| needle | scenes | reference | ∞ | ∞ | means | right |  |" in text
        assert "| mirror | scenes | - | – | – | means | refused | det -1 |" in text


def test_the_page_has_one_line_per_case_with_its_worst_backend(run, tmp_path):
    page = tmp_path / "page.md"
    run(ROWS, "--page", str(page), "--device", "cpu")
    text = page.read_text()
    assert text.startswith("# Results: numerically hard cases\n\nCommit: ")
    assert "## Scenes" in text
    assert "| needle | ∞ | ∞ | right, native: finite only |  |" in text
    assert "| mirror | – | – | refused | det -1 |" in text


def test_an_unexpected_status_is_written_and_ends_in_an_error(run, tmp_path):
    bad = row("needle", "torch", "not finite", expected="right")
    with pytest.raises(SystemExit, match=r"1 of 5 cases .* needle \(torch\): expected right"):
        run([*ROWS, bad])
    assert (tmp_path / "out" / "stability.md").is_file()
