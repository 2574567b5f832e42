"""Tables as Markdown, LaTeX, HTML, JSON and on the terminal."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import pandas as pd

from gsgan.utils.pages import markdown as markdown_table

NOT_HAD = "n/a"
NO_RUN = "–"
ORIGIN = ("seeds", "data", "protocol", "commit")  # columns after the scores


@dataclass(frozen=True)
class Cell:
    """One value: its text, the numbers behind it, notes below the table, best of its column."""

    text: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    best: bool = False


@dataclass(frozen=True)
class Row:
    """One row: label, a cell per column, a text for each of `ORIGIN` or none, notes on all of it.

    ``kind`` is ``floor`` for the all-background image, ``paper`` for numbers that the paper prints.
    """

    label: str
    cells: Sequence[Cell]
    origin: Sequence[str] = ()
    kind: Literal["run", "floor", "paper"] = "run"
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Grid:
    """One table: its heading, the headings of its cells, its rows, remarks below it."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Row]
    remarks: Sequence[str] = ()


@dataclass(frozen=True)
class Report:
    """All that is shown, one record per run (JSON only), and reasons by folder of runs left out."""

    name: str
    title: str
    grids: Sequence[Grid]
    runs: Sequence[Mapping[str, Any]]
    left_out: Mapping[str, str] = field(default_factory=dict)

    def notes(self) -> dict[str, str]:
        """A number for every note, in the order of appearance."""
        rows = [row for grid in self.grids for row in grid.rows]
        notes = (n for row in rows for n in (*row.notes, *(n for c in row.cells for n in c.notes)))
        return {note: str(i) for i, note in enumerate(dict.fromkeys(notes), start=1)}


def common(texts: Iterable[str]) -> str:
    """Texts joined, each once, in order."""
    return ", ".join(dict.fromkeys(text for text in texts if text))


@dataclass(frozen=True)
class Format:
    """How text is written in one format: escaped, as a table of a title and cells, and by patterns
    for labels, best values, numbers of notes and remarks; ``origin`` adds the columns `ORIGIN`."""

    escape: Callable[[str], str]
    table: Callable[[str, pd.DataFrame], str]
    italic: str
    bold: str
    raised: str
    line: str = "{}"
    origin: bool = True

    def grid(self, grid: Grid, notes: Mapping[str, str]) -> str:
        """One table with its remarks."""

        def cell(text: str, marks: Sequence[str], pattern: str) -> str:
            raised = self.raised.format(" ".join(notes[mark] for mark in marks)) if marks else ""
            return pattern.format(self.escape(text)) + raised

        origin = ORIGIN if self.origin and any(row.origin for row in grid.rows) else ()
        rows = [
            [
                cell(row.label, row.notes, "{}" if row.kind == "run" else self.italic),
                *(cell(c.text, c.notes, self.bold if c.best else "{}") for c in row.cells),
                *(self.escape(text) for text in row.origin if origin),
            ]
            for row in grid.rows
        ]
        frame = pd.DataFrame(rows, columns=[*map(self.escape, ("", *grid.columns, *origin))])
        return "\n\n".join([self.table(self.escape(grid.title), frame), *self.lines(grid.remarks)])

    def lines(self, texts: Iterable[str]) -> list[str]:
        """Remarks."""
        return [self.line.format(self.escape(text)) for text in texts]

    def body(self, report: Report) -> str:
        """All but the title."""
        notes = report.notes()
        below = [f"{number}: {note}" for note, number in notes.items()]
        below += [f"Left out: {folder}: {reason}" for folder, reason in report.left_out.items()]
        return "\n\n".join([*(self.grid(grid, notes) for grid in report.grids), *self.lines(below)])


def _escape_markdown(text: str) -> str:
    text = re.sub(r"([\\`*\[\]<>~$])", r"\\\1", text.replace("&", "&amp;"))
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", text)


def _markdown_table(title: str, frame: pd.DataFrame) -> str:
    return f"**{title}**\n\n" + markdown_table(list(frame.columns), frame.to_numpy().tolist())


LATEX_LETTERS = str.maketrans(
    {c: f"\\{c}" for c in "{}$&#%_"}
    | {c: f"{{{c}}}" for c in "[]*"}  # after \\ they would be an argument
    | {"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "\n": " "}
    | {"±": r"$\pm$", "−": "$-$", "→": r"$\rightarrow$", "↑": r"$\uparrow$"}
    | {"↓": r"$\downarrow$", "Ψ": r"$\Psi$", "…": r"\ldots{}", "–": "--", "²": "$^2$"}
)


def _escape_latex(text: str) -> str:
    """Letters that pdfLaTeX's fonts lack are written as their code point."""
    known = text.translate(LATEX_LETTERS)
    return "".join(c if c < "\u0180" else f"{{[}}U+{ord(c):04X}{{]}}" for c in known)


def _latex_table(title: str, frame: pd.DataFrame) -> str:
    """A ``table`` that is no wider than the text."""
    tabular = frame.to_latex(index=False, escape=False, column_format="l" + "r" * len(frame.T[1:]))
    return (
        f"\\begin{{table}}\n\\centering\n\\caption{{{title}}}\n"
        "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%\n"
        f"{tabular.rstrip()}}}\n\\end{{table}}"
    )


def _html_table(title: str, frame: pd.DataFrame) -> str:
    with pd.option_context("display.max_colwidth", None):  # it would cut long texts off
        return f"<h2>{title}</h2>\n" + frame.to_html(index=False, escape=False, border=0)


MARKDOWN = Format(_escape_markdown, _markdown_table, "*{}*", "**{}**", "<sup>{}</sup>")
TERMINAL = Format(_escape_markdown, _markdown_table, "*{}*", "**{}**", " ({})", origin=False)
LATEX = Format(
    _escape_latex, _latex_table, r"\textit{{{}}}", r"\textbf{{{}}}", r"\textsuperscript{{{}}}"
)
HTML = Format(
    html.escape, _html_table, "<em>{}</em>", "<strong>{}</strong>", "<sup>{}</sup>", "<p>{}</p>"
)
HTML_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title><style>
body {{ font: 15px/1.45 system-ui, sans-serif; color: #222; margin: 1.2em; background: #fafafa; }}
table {{ border-collapse: collapse; border: solid #222; border-width: 2px 0; background: #fff; }}
th, td {{ padding: .25em .8em; text-align: right; white-space: nowrap; }}
thead th {{ border-bottom: 1px solid #222; }} th:first-child, td:first-child {{ text-align: left; }}
p {{ color: #555; font-size: .9em; max-width: 60em; }} sup {{ line-height: 0; font-size: .7em; }}
</style></head><body><h1>{title}</h1>
{body}
</body></html>
"""


def pages(report: Report) -> dict[str, str]:
    """The files of a report by name.

    LaTeX has a ``table`` per grid, for ``\\input``; HTML is one file without scripts; JSON has
    every cell's text, numbers and notes, every row's origin, and every run.
    """

    def plain(row: Row, columns: Sequence[str]) -> dict[str, Any]:
        cells = {
            name: {"text": cell.text, **cell.numbers, "notes": cell.notes}
            for name, cell in zip(columns, row.cells, strict=True)
        }
        origin = dict(zip(ORIGIN, row.origin, strict=False))
        return {"label": row.label, "kind": row.kind, "cells": cells, "notes": row.notes, **origin}

    grids = [
        {**vars(grid), "rows": [plain(row, grid.columns) for row in grid.rows]}
        for grid in report.grids
    ]
    held = {"table": report.name, "title": report.title, "grids": grids, "runs": report.runs}
    held["left_out"] = [{"folder": f, "reason": why} for f, why in report.left_out.items()]
    packages = "% needs \\usepackage{booktabs} and, for wide tables, \\usepackage{graphicx}"
    return {
        "report.md": f"# {MARKDOWN.escape(report.title)}\n\n{MARKDOWN.body(report)}\n",
        "report.tex": f"{packages}\n\n{LATEX.body(report)}\n",
        "report.html": HTML_PAGE.format(title=html.escape(report.title), body=HTML.body(report)),
        "report.json": json.dumps(held, indent=1, allow_nan=False, ensure_ascii=False) + "\n",
    }
