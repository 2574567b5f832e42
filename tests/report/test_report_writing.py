"""Markdown, LaTeX, HTML and JSON of one report: escaped, complete, well formed."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import pytest
from rich.console import Console

from gsgan.report.grid import Cell, Grid, Report, Row, footnotes, letters
from gsgan.report.writers import html, latex, markdown, numbers
from gsgan.report.writers.terminal import print_report

NASTY = r"a_b & 50% <b>|x|</b> {y} #1 $2 ~ ^ \cmd *[z]* ± −"
ORIGIN = ("3", "data_set, my_377", "none", "abc123")


@pytest.fixture
def report():
    rows = [
        Row(NASTY, [Cell("31.00 ± 1.00", {"mean": 31.0}), Cell("n/a", {}, (NASTY,))], ORIGIN),
        Row("GAN (paper)", [Cell("34.16"), Cell("n/a")], ("n/a",) * 4, "paper"),
        Row("floor", [Cell("15.00"), Cell("n/a", {}, ("no parts",))], ORIGIN, "floor", ("a note",)),
    ]
    grid = Grid("novel_pose: 100% [f00d]", ["PSNR ↑", "mIoU [a] ↑"], rows, remarks=("Row − full.",))
    runs = Grid("Runs", ["row"], [Row("folder_a", [Cell("full")])], first="folder")
    return Report("t", "A & B", [grid], runs, ["Remark_1."], [("bad_run", "damaged <x>")])


def test_notes_get_letters_in_the_order_they_are_met(report):
    assert footnotes(report.grids) == {NASTY: "a", "a note": "b", "no parts": "c"}
    assert [letters(i) for i in (0, 25, 26, 27, 701, 702)] == ["a", "z", "aa", "ab", "zz", "aaa"]


def test_markdown_tables_have_as_many_cells_in_every_row(report):
    text = markdown.page(report)
    lines = [line for line in text.splitlines() if line.startswith("|")]
    counts = [len(re.findall(r"(?<!\\)\|", line)) for line in lines]
    assert counts == [8] * 5 + [3] * 3
    assert r"\<b\>" in text
    assert r"\$2 \~ ^" in text  # neither a formula nor struck out
    assert "bad_run" in text
    assert "<sup>a</sup>" in text
    assert "## Runs" not in markdown.block(report)


def test_latex_is_escaped_balanced_and_rectangular(report):
    text = latex.page(report)
    for name in ("table", "tabular"):
        begins, ends = (text.count(rf"\{word}{{{name}}}") for word in ("begin", "end"))
        assert begins == ends == 1
    assert [text.count(rule) for rule in (r"\toprule", r"\bottomrule")] == [1, 1]
    body = text[text.index(r"\toprule") : text.index(r"\bottomrule")]
    lines = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert [len(re.findall(r"(?<!\\)&", line)) for line in lines] == [6] * 4
    assert r"\begin{tabular}{lrrllll}" in text
    plain = re.sub(r"(?m)^%.*$|\{%$", "", text)  # but for comments
    assert not re.search(r"(?<!\\)[%#_^~]", plain)
    assert plain.isascii()
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
    assert "% left out: bad_run: damaged <x>" in text


@pytest.mark.parametrize(
    ("raw", "spelled"),
    [
        ("a_b", r"a\_b"),
        ("50%", r"50\%"),
        ("\\", r"\textbackslash{}"),
        ("{x}", r"\{x\}"),
        ("~^", r"\textasciitilde{}\textasciicircum{}"),
        ("1 ± 2", r"1 $\pm$ 2"),
        ("−1", "$-$1"),
        ("[0, 1]", "{[}0, 1{]}"),
        ("a\nb", "a b"),
        ("*a", "{*}a"),  # behind \\\\ it would be the starred command
        ("é σ π", r"é $\sigma$ {[}U+03C0{]}"),
    ],
)
def test_latex_escapes(raw, spelled):
    assert latex.escape(raw) == spelled


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.open, self.seen, self.text = [], [], ""

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        assert not {"src", "href", "onclick"} & {name for name, _ in attrs}
        if tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def test_html_is_well_formed_escaped_and_fetches_nothing(report):
    tags = Tags()
    tags.feed(html.page(report))
    assert not tags.open
    assert not {"script", "link", "img", "b"} & set(tags.seen)
    assert NASTY in tags.text
    assert "damaged <x>" in tags.text
    assert '<tr class="floor">' in html.page(report)


def test_json_holds_every_number(report):
    held = json.loads(numbers.text(report))
    first = held["grids"][0]["rows"][0]
    assert first["cells"]["PSNR ↑"] == {"text": "31.00 ± 1.00", "mean": 31.0, "notes": []}
    assert first["commit"] == "abc123"
    assert held["left_out"] == [{"folder": "bad_run", "reason": "damaged <x>"}]


def test_the_terminal_says_below_where_rows_are_from():
    rows = [Row(name, [Cell("1")], (n, "d", "p", "c")) for name, n in (("a", "3"), ("b", "1"))]
    rows += [Row("none", [Cell("–")], ("0", "–", "–", "–")), Row("f", [Cell("0")], (), "floor")]
    report = Report("t", "T", [Grid("g", ["x"], rows)], Grid("Runs", [], []))
    console = Console(record=True, width=100)
    print_report(report, console)
    text = console.export_text()
    assert "seeds: 3 (a), 1 (b); data: d; protocol: p; commit: c" in text


def test_the_terminal_shows_it_all_without_markup(report):
    console = Console(record=True, width=160)
    print_report(report, console)
    text = console.export_text()
    for word in (
        NASTY,
        "31.00 ± 1.00",
        "left out: bad_run",
        "commit: abc123",
        "a: ",
        "100% [f00d]",
        "mIoU [a]",
    ):
        assert word in text
