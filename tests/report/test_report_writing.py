"""Markdown, LaTeX and CSV of one report: escaped, complete, well formed."""

import io
import re

import pandas as pd
import pytest
from rich.console import Console
from rich.markdown import Markdown

from gsgan.report import write
from gsgan.report.write import Cell, Grid, Report, Row

NASTY = r"a_b & 50% <b>|x|</b> {y} #1 $2 ~ ^ \cmd *[z]* ± −"
ORIGIN = ("3", "data_set, my_377", "none", "abc123")


@pytest.fixture
def report():
    best = Cell("31.00 ± 1.00", 31.0, 1.0, best=True)
    rows = [
        Row(NASTY, [best, Cell("n/a", notes=(NASTY,))], ORIGIN),
        Row("GAN (paper)", [Cell("34.16"), Cell("n/a")], ("n/a",) * 4, "paper"),
        Row(
            "floor",
            [Cell("15.00"), Cell("n/a", notes=("no parts",))],
            ORIGIN,
            "floor",
            ("a note",),
        ),
    ]
    grid = Grid(
        "novel_pose: 100% [f00d]",
        ["PSNR ↑", "mIoU [a] ↑"],
        rows,
        ("Row − full.",),
    )
    return Report("A & B", [grid], {"bad_run": "damaged <x>"})


def test_notes_are_numbered_in_the_order_of_appearance(report):
    assert report.notes() == {NASTY: "1", "a note": "2", "no parts": "3"}


def test_markdown_tables_have_as_many_cells_in_every_row(report):
    text = write.files_of(report)["report.md"]
    lines = [line for line in text.splitlines() if line.startswith("|")]
    counts = [len(re.findall(r"(?<!\\)\|", line)) for line in lines]
    assert counts == [8] * 5
    assert r"\<b\>" in text
    assert r"\$2 \~ ^" in text  # neither a formula nor struck out
    assert "bad_run" in text
    assert "**31.00 ± 1.00**" in text
    assert "<sup>1</sup>" in text


def test_latex_is_escaped_balanced_and_rectangular(report):
    text = write.files_of(report)["report.tex"]
    for name in ("table", "tabular"):
        begins, ends = (
            text.count(rf"\{word}{{{name}}}") for word in ("begin", "end")
        )
        assert begins == ends == 1
    assert [text.count(rule) for rule in (r"\toprule", r"\bottomrule")] == [
        1,
        1,
    ]
    body = text[text.index(r"\toprule") : text.index(r"\bottomrule")]
    lines = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert [len(re.findall(r"(?<!\\)&", line)) for line in lines] == [6] * 4
    assert r"\begin{tabular}{lrrrrrr}" in text
    assert r"\textbf{31.00 $\pm$ 1.00}" in text
    plain = re.sub(r"(?m)^%.*$|\{%$", "", text)  # without comments
    assert not re.search(r"(?<!\\)[%#_^~]", plain)
    assert plain.isascii()
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(
        r"\}"
    )
    assert r"Left out: bad\_run: damaged \textless{}x\textgreater{}" in text


def test_the_terminal_shows_it_all_without_markup(report):
    console = Console(record=True, width=160)
    console.print(Markdown(write.TERMINAL.body(report)))
    text = console.export_text()
    for word in (
        NASTY,
        "31.00 ± 1.00",
        "Left out: bad_run: damaged <x>",
        "n/a (1)",
        "2: a note",
        "100% [f00d]",
        "mIoU [a]",
    ):
        assert word in text


def test_csv_has_every_number(report):
    frame = pd.read_csv(io.StringIO(write.files_of(report)["report.csv"]))
    assert len(frame) == 6
    assert frame.iloc[0].tolist()[2:] == ["PSNR ↑", "31.00 ± 1.00", 31.0, 1.0]
