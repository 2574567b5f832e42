"""Tables as text: Markdown, LaTeX, HTML, JSON and the terminal, from the same cells."""

from __future__ import annotations

import html
import json
import re
import string
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import pandas as pd
from jinja2 import Environment, PackageLoader
from rich import box
from rich import markup as rich_markup
from rich.console import Console
from rich.table import Table

from gsgan.utils.pages import markdown as markdown_table

NOT_HAD = "n/a"
NO_RUN = "–"
ORIGIN = ("seeds", "data", "protocol", "commit")  # columns after the scores


@dataclass(frozen=True)
class Cell:
    """One value.

    Args:
        text: as shown.
        numbers: the digits behind it, for report.json.
        notes: below the table.
        best: of its column.
    """

    text: str
    numbers: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    best: bool = False


@dataclass(frozen=True)
class Row:
    """One row.

    Args:
        label: its first column.
        cells: one per column.
        origin: a text for each of ``ORIGIN``, or none.
        kind: ``floor`` for the all-background image, ``paper`` for numbers of the paper.
        notes: below the table, on the whole row.
    """

    label: str
    cells: Sequence[Cell]
    origin: Sequence[str] = ()
    kind: Literal["run", "floor", "paper"] = "run"
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Grid:
    """One table: its heading, the headings of its cells, rows, remarks, heading of the labels."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Row]
    remarks: tuple[str, ...] = ()
    first: str = ""

    @property
    def origin(self) -> tuple[str, ...]:
        """Headings of the columns that say where the rows are from."""
        return ORIGIN if any(row.origin for row in self.rows) else ()


@dataclass(frozen=True)
class Report:
    """Everything shown: the tables, one row per run, remarks on all, (folder, reason) left out."""

    name: str
    title: str
    grids: Sequence[Grid]
    runs: Grid
    remarks: Sequence[str] = ()
    left_out: Sequence[tuple[str, str]] = ()

    def notes(self) -> dict[str, str]:
        """A letter for every note, in the order of appearance."""
        rows = [row for grid in self.grids for row in grid.rows]
        notes = (n for row in rows for n in (*row.notes, *(n for c in row.cells for n in c.notes)))
        return {note: letters(i) for i, note in enumerate(dict.fromkeys(notes))}


def letters(index: int) -> str:
    """a, b, … z, aa, ab, …"""
    text, index = "", index + 1
    while index:
        index, rest = divmod(index - 1, 26)
        text = string.ascii_lowercase[rest] + text
    return text


def common(texts: Iterable[str]) -> str:
    """Texts joined, each once, in order."""
    return ", ".join(dict.fromkeys(text for text in texts if text))


@dataclass(frozen=True)
class Markup:
    """How one format writes text: an escape function, and patterns for emphasis and notes."""

    escape: Callable[[str], str]
    italic: str
    bold: str
    raised: str

    def table(self, grid: Grid, notes: Mapping[str, str]) -> pd.DataFrame:
        """The grid as text: labels, cells, origin."""

        def cell(text: str, marks: Sequence[str], pattern: str = "{}") -> str:
            raised = self.raised.format(" ".join(notes[m] for m in marks)) if marks else ""
            return pattern.format(self.escape(text)) + raised

        rows = [
            [
                cell(row.label, row.notes, "{}" if row.kind == "run" else self.italic),
                *(cell(c.text, c.notes, self.bold if c.best else "{}") for c in row.cells),
                *map(self.escape, row.origin or [""] * len(grid.origin)),
            ]
            for row in grid.rows
        ]
        header = [grid.first, *grid.columns, *grid.origin]
        return pd.DataFrame(rows, columns=[self.escape(name) for name in header], dtype=object)


def _escape_markdown(text: str) -> str:
    text = re.sub(r"([\\`*\[\]<>~$])", r"\\\1", text.replace("&", "&amp;"))
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", text)


LATEX_LETTERS = str.maketrans(
    {c: f"\\{c}" for c in "{}$&#%_"}
    | {c: f"{{{c}}}" for c in "[]*"}  # after \\ they would be an argument
    | {"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}"}
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "\n": " "}
    | {"±": r"$\pm$", "−": "$-$", "×": r"$\times$", "→": r"$\rightarrow$", "↑": r"$\uparrow$"}
    | {"↓": r"$\downarrow$", "²": "$^2$", "µ": r"$\mu$", "Ψ": r"$\Psi$", "λ": r"$\lambda$"}
    | {"…": r"\ldots{}", "–": "--", "σ": r"$\sigma$", "≥": r"$\geq$"}
)


def _escape_latex(text: str) -> str:
    """Letters that pdfLaTeX's fonts lack are written as their code point."""
    known = text.translate(LATEX_LETTERS)
    return "".join(c if c < "\u0180" else f"{{[}}U+{ord(c):04X}{{]}}" for c in known)


MARKDOWN = Markup(_escape_markdown, "*{}*", "**{}**", "<sup>{}</sup>")
HTML = Markup(html.escape, "<em>{}</em>", "<strong>{}</strong>", "<sup>{}</sup>")
LATEX = Markup(_escape_latex, r"\textit{{{}}}", r"\textbf{{{}}}", r"\textsuperscript{{{}}}")
TERMINAL = Markup(rich_markup.escape, "[italic]{}[/italic]", "[bold]{}[/bold]", " [cyan]{}[/cyan]")


def markdown_block(report: Report) -> str:
    """All but the title and the list of runs: what another page shows."""
    notes, escape = report.notes(), MARKDOWN.escape
    parts = []
    for grid in report.grids:
        parts += [f"**{escape(grid.title)}**", _markdown_grid(grid, notes)]
        parts += ["\n".join(map(escape, grid.remarks))] if grid.remarks else []
    parts.append("\n".join(f"- {letter}: {escape(note)}" for note, letter in notes.items()))
    parts.append("\n".join(map(escape, report.remarks)))
    if report.left_out:
        parts += ["Left out:"]
        parts += ["\n".join(f"- `{folder}`: {escape(why)}" for folder, why in report.left_out)]
    return "\n\n".join(part for part in parts if part)


def markdown_page(report: Report) -> str:
    """report.md."""
    runs = f"## {report.runs.title}\n\n{_markdown_grid(report.runs, {})}"
    return f"# {MARKDOWN.escape(report.title)}\n\n{markdown_block(report)}\n\n{runs}\n"


def _markdown_grid(grid: Grid, notes: Mapping[str, str]) -> str:
    table = MARKDOWN.table(grid, notes)
    return markdown_table(list(table.columns), table.to_numpy().tolist())


def html_page(report: Report) -> str:
    """report.html: one file, no scripts, nothing fetched."""
    notes = report.notes()
    environment = Environment(loader=PackageLoader("gsgan.report", ""), autoescape=True)
    with pd.option_context("display.max_colwidth", None):
        tables = [
            HTML.table(grid, notes).to_html(index=False, escape=False, border=0)
            for grid in (*report.grids, report.runs)
        ]
    template = environment.get_template("report.html.j2")
    grids = zip((*report.grids, report.runs), tables, strict=True)
    return template.render(report=report, grids=grids, notes=notes) + "\n"


def latex_page(report: Report) -> str:
    """report.tex: one ``table`` per grid, for ``\\input``."""
    parts = ["% needs \\usepackage{booktabs} and, for wide tables, \\usepackage{graphicx}"]
    parts += [f"% left out: {' '.join(f'{name}: {why}'.split())}" for name, why in report.left_out]
    parts += [_latex_grid(grid, report) for grid in report.grids]
    return "\n\n".join(parts) + "\n"


def _latex_grid(grid: Grid, report: Report) -> str:
    notes = Report("", "", [grid], grid).notes()
    columns = "l" + "r" * len(grid.columns) + "l" * len(grid.origin)
    tabular = LATEX.table(grid, notes).to_latex(index=False, escape=False, column_format=columns)
    below = [LATEX.raised.format(letter) + f" {_escape_latex(n)}" for n, letter in notes.items()]
    below += map(_escape_latex, (*grid.remarks, *report.remarks))
    return "\n".join(
        [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{_escape_latex(f'{report.title}: {grid.title}')}}}",
            r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
            tabular.rstrip() + "}",
            r"\par\smallskip\raggedright\footnotesize",
            "\\\\\n".join(below),
            r"\end{table}",
        ]
    )


def json_text(report: Report) -> str:
    """report.json: every cell's text, numbers and notes, every row's origin."""
    held = {
        "table": report.name,
        "title": report.title,
        "grids": [
            {
                "title": grid.title,
                "columns": list(grid.columns),
                "rows": _json_rows(grid),
                "remarks": list(grid.remarks),
            }
            for grid in report.grids
        ],
        "runs": _json_rows(report.runs),
        "remarks": list(report.remarks),
        "left_out": [{"folder": name, "reason": why} for name, why in report.left_out],
    }
    return json.dumps(held, indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _json_rows(grid: Grid) -> list[dict[str, Any]]:
    return [
        {
            "label": row.label,
            "kind": row.kind,
            "cells": {
                name: {"text": cell.text, **cell.numbers, "notes": list(cell.notes)}
                for name, cell in zip(grid.columns, row.cells, strict=True)
            },
            "notes": list(row.notes),
            **dict(zip(grid.origin, row.origin, strict=bool(row.origin))),
        }
        for row in grid.rows
    ]


def print_report(report: Report, console: Console) -> None:
    """The scores, where they are from, the notes, and last what was left out."""
    notes = report.notes()

    def say(text: str, style: str = "") -> None:
        console.print(text, style=style, markup=False, highlight=False, soft_wrap=True)

    for grid in report.grids:
        drawn = Table(
            title=rich_markup.escape(grid.title), title_justify="left", box=box.SIMPLE_HEAD
        )
        text = TERMINAL.table(grid, notes).iloc[:, : 1 + len(grid.columns)]
        for i, name in enumerate(text.columns):
            drawn.add_column(name, justify="right" if i else "left", no_wrap=not i, overflow="fold")
        for row in text.itertuples(index=False):
            drawn.add_row(*row)
        console.print(drawn)
        rows = [row for row in grid.rows if row.kind != "floor" and NO_RUN not in row.origin]
        origin = [
            f"{name}: {common(row.origin[i] for row in rows)}" for i, name in enumerate(ORIGIN)
        ]
        for remark in (*grid.remarks, "; ".join(origin)):
            say(f"  {remark}", "dim")
    for note, letter in notes.items():
        say(f"  {letter}: {note}")
    for remark in report.remarks:
        say(f"  {remark}")
    for folder, reason in report.left_out:
        say(f"left out: {folder}: {reason}", "yellow")


WRITERS = {
    "report.md": markdown_page,
    "report.tex": latex_page,
    "report.html": html_page,
    "report.json": json_text,
}
