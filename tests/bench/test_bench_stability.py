"""The stability subject: its tables, its exit."""

from __future__ import annotations

import json
import math

import pytest

from gsgan.bench import stability
from gsgan.bench.cases.case import Row
from gsgan.utils.errors import GsganError


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
def run(compose, tmp_path, monkeypatch):
    def go(rows, *overrides):
        monkeypatch.setattr(stability, "compare_all", lambda device: iter(rows))
        config = compose("bench_stability", "device=cpu", "threads=1", *overrides)
        stability.run(config, tmp_path / "out")
        return tmp_path / "out"

    return go


def test_every_row_is_written_and_nan_is_null(run):
    folder = run(ROWS)
    records = json.loads((folder / "stability.json").read_text())["rows"]
    assert [r["value_error"] for r in records] == [1e-6, 3e-2, None, None]
    assert (folder / "stability.csv").read_text().count("\n") == 5
    page = (folder / "stability.md").read_text()
    assert "| needle | scenes | native | 0.030 | 0.060 | means | finite only |  |" in page
    assert "| needle | scenes | reference | ∞ | ∞ | means | right |  |" in page
    assert "| mirror | scenes | - | – | – | means | refused | det -1 |" in page


def test_the_docs_have_one_line_per_case_with_its_worst_backend(run, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- bench:stability --><!-- end -->")
    run(ROWS, f"docs={page}")
    text = page.read_text()
    assert "### Scenes" in text
    assert "| needle | ∞ | ∞ | right, native: finite only |  |" in text
    assert "| mirror | – | – | refused | det -1 |" in text


def test_an_unexpected_status_is_written_and_ends_in_an_error(run, tmp_path):
    bad = row("needle", "torch", "not finite", expected="right")
    with pytest.raises(GsganError, match=r"1 of 5 cases .* needle \(torch\): expected right"):
        run([*ROWS, bad])
    assert (tmp_path / "out" / "stability.md").is_file()
