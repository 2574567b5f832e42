"""``make stability``: its tables, its exit."""

import importlib.util
import json
import math
import sys
from pathlib import Path

import pytest

from stability.cases.case import Row

SCRIPT = Path(__file__).parents[2] / "scripts" / "stability.py"
ROWS = [
    Row("needle", "scenes", "torch", 1e-6, 2e-6, "means", "right", "right", ""),
    Row(
        "needle",
        "scenes",
        "native",
        3e-2,
        6e-2,
        "means",
        "finite only",
        "finite only",
        "",
    ),
    Row(
        "needle",
        "scenes",
        "reference",
        math.inf,
        math.inf,
        "means",
        "right",
        "right",
        "",
    ),
    Row(
        "mirror",
        "scenes",
        "-",
        math.nan,
        math.nan,
        "means",
        "refused",
        "refused",
        "det -1",
    ),
]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs the script on given rows; the folder that it writes."""
    spec = importlib.util.spec_from_file_location("stability_script", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)

    def go(rows, *options):
        monkeypatch.setattr(script, "compare_all", lambda device: iter(rows))
        given = ["--out", str(tmp_path), "--device", "cpu", *options]
        monkeypatch.setattr(sys, "argv", ["stability.py", *given])
        script.main()

    return go


def test_every_row_is_in_the_table_and_cases_that_are_not_right_on_the_page(
    run, tmp_path, capsys
):
    page = tmp_path / "page.md"
    run(ROWS, "--page", str(page))
    records = json.loads((tmp_path / "stability.json").read_text())["rows"]
    # JSON has no NaN
    assert [r["value_error"] for r in records] == [1e-6, 3e-2, None, None]
    for text in (
        (tmp_path / "stability.md").read_text(),
        capsys.readouterr().out,
    ):
        assert (
            "| needle | scenes | native | 0.030 | 0.060 | means | finite only |  |"
            in text
        )
        assert (
            "| needle | scenes | reference | ∞ | ∞ | means | right |  |" in text
        )
        assert (
            "| mirror | scenes | - | – | – | means | refused | det -1 |" in text
        )
    text = page.read_text()
    assert text.startswith("# Results: numerically hard cases\n\nCommit: ")
    assert "| Scenes | 2 | 0 | – | – |" in text
    assert "| needle | ∞ | ∞ | right, native: finite only |  |" in text
    assert "| mirror | – | – | refused | det -1 |" in text


def test_an_unexpected_status_is_written_and_ends_in_an_error(run, tmp_path):
    bad = ROWS[0]._replace(status="not finite")
    with pytest.raises(SystemExit, match=r"1 of 5 .*needle \(torch\)"):
        run([*ROWS, bad])
    assert (tmp_path / "stability.md").is_file()
