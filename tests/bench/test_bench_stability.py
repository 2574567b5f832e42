"""The stability subject: its tables, its exit."""

from __future__ import annotations

import json
import math

import pytest

from gsgan.bench import stability
from gsgan.bench.cases import Row
from gsgan.bench.environment import Environment
from gsgan.utils.errors import GsganError

WHERE = Environment("cpu", "Abacus", 1, "2026-01-01", {}, None)


def row(case: str, backend: str, verdict: str = "right", error: float = 1e-6, **more) -> Row:
    values = {
        "case": case, "subject": "scenes", "backend": backend, "dtype": "float32",
        "value_error": error, "gradient_error": 2 * error, "worst_input": "means",
        "finite_values": True, "finite_gradients": True, "verdict": verdict, "expected": verdict,
        "note": "",
    }  # fmt: skip
    return Row(**(values | more))


ROWS = [
    row("needle", "torch"),
    row("needle", "native", "finite only", 3e-2),
    row("mirror", "-", "refused", math.nan, note="det -1"),
]


@pytest.fixture
def run(compose, tmp_path, monkeypatch):
    def go(rows, *overrides):
        monkeypatch.setattr(stability, "verdicts", lambda device: iter(rows))
        config = compose("bench_stability", "device=cpu", "threads=1", *overrides)
        stability.run(config, tmp_path / "out")
        return tmp_path / "out"

    return go


def test_every_row_is_written_and_nan_is_null(run):
    folder = run(ROWS)
    records = json.loads((folder / "stability.json").read_text())["rows"]
    assert [r["value_error"] for r in records] == [1e-6, 3e-2, None]
    assert (folder / "stability.csv").read_text().count("\n") == 4
    page = (folder / "stability.md").read_text()
    assert "| needle | scenes | native | 0.030 | 0.060 | means | finite only |  |" in page
    assert "| mirror | scenes | - | – | – | means | refused | det -1 |" in page


def test_the_docs_have_one_line_a_case_with_its_worst_backend(run, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- bench:stability --><!-- end -->")
    run(ROWS, f"docs={page}")
    text = page.read_text()
    assert "### Scenes" in text
    assert "| needle | 0.030 | 0.060 | right, native: finite only |  |" in text
    assert "| mirror | – | – | refused | det -1 |" in text


def test_an_infinite_error_is_shown_and_not_the_next_largest(run, tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- bench:stability --><!-- end -->")
    folder = run([row("needle", "torch"), row("needle", "native", error=math.inf)], f"docs={page}")
    assert "| needle | ∞ | ∞ | right |  |" in page.read_text()
    assert (
        "| needle | scenes | native | ∞ | ∞ | means | right |  |"
        in (folder / "stability.md").read_text()
    )


def test_an_unexpected_verdict_is_written_and_ends_in_an_error(run, tmp_path):
    bad = row("needle", "torch", "not finite", expected="right")
    with pytest.raises(GsganError, match=r"1 of 4 verdicts .* needle \(torch\): expected right"):
        run([*ROWS, bad])
    assert (tmp_path / "out" / "stability.md").is_file()
