"""Tables as Markdown and LaTeX."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import pandas as pd

from gsgan.utils.pages import markdown as markdown_table

NOT_HAD = "n/a"
NO_RUN = "–"
ORIGIN = ("seeds", "data", "protocol", "commit")  # columns after the scores


@dataclass(frozen=True)
class Cell:
    """One value: its text, mean and spread, notes below the table, and whether it is the best of
    its column."""

    text: str
    mean: float | None = None
    spread: float | None = None
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
    """All tables, and the reasons by folder of runs that were left out."""

    title: str
    grids: Sequence[Grid]
    left_out: Mapping[str, str] = field(default_factory=dict)

    def notes(self) -> dict[str, str]:
        """A number for every note, in the order of appearance."""
        rows = [row for grid in self.grids for row in grid.rows]
        notes = (
            n
            for row in rows
            for n in (*row.notes, *(n for c in row.cells for n in c.notes))
        )
        return {note: str(i) for i, note in enumerate(dict.fromkeys(notes), start=1)}

    def frame(self) -> pd.DataFrame:
        """One row per value: table, row, column, text, mean and spread."""
        values = [
            (grid.title, row.label, column, cell.text, cell.mean, cell.spread)
            for grid in self.grids
            for row in grid.rows
            for column, cell in zip(grid.columns, row.cells, strict=True)
        ]
        return pd.DataFrame(
            values, columns=["table", "row", "column", "text", "mean", "spread"]
        )


def join_unique(texts: Iterable[str]) -> str:
    """The texts that are not empty, each once, joined by commas."""
    return ", ".join(dict.fromkeys(text for text in texts if text))


@dataclass(frozen=True)
class Format:
    """How text is written in one format: a function that escapes it, one that makes a table of a
    title and cells, and patterns; ``origin`` adds the columns `ORIGIN`."""

    escape: Callable[[str], str]
    table: Callable[[str, pd.DataFrame], str]
    italic: str
    bold: str
    raised: str  # numbers of notes
    origin: bool = True

    def grid(self, grid: Grid, notes: Mapping[str, str]) -> str:
        """One table with its remarks."""

        def cell(text: str, marks: Sequence[str], pattern: str) -> str:
            raised = (
                self.raised.format(" ".join(notes[mark] for mark in marks))
                if marks
                else ""
            )
            return pattern.format(self.escape(text)) + raised

        origin = ORIGIN if self.origin and any(row.origin for row in grid.rows) else ()
        rows = [
            [
                cell(row.label, row.notes, "{}" if row.kind == "run" else self.italic),
                *(
                    cell(c.text, c.notes, self.bold if c.best else "{}")
                    for c in row.cells
                ),
                *(self.escape(text) for text in row.origin if origin),
            ]
            for row in grid.rows
        ]
        frame = pd.DataFrame(
            rows, columns=[*map(self.escape, ("", *grid.columns, *origin))]
        )
        table = self.table(self.escape(grid.title), frame)
        return "\n\n".join([table, *map(self.escape, grid.remarks)])

    def body(self, report: Report) -> str:
        """All but the title."""
        notes = report.notes()
        below = [f"{number}: {note}" for note, number in notes.items()]
        below += [
            f"Left out: {folder}: {reason}"
            for folder, reason in report.left_out.items()
        ]
        tables = (self.grid(grid, notes) for grid in report.grids)
        return "\n\n".join([*tables, *map(self.escape, below)])


def _escape_markdown(text: str) -> str:
    text = re.sub(r"([\\`*\[\]<>~$])", r"\\\1", text.replace("&", "&amp;"))
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", text)


def _markdown_table(title: str, frame: pd.DataFrame) -> str:
    return f"**{title}**\n\n" + markdown_table(
        list(frame.columns), frame.to_numpy().tolist()
    )


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
    tabular = frame.to_latex(
        index=False, escape=False, column_format="l" + "r" * len(frame.T[1:])
    )
    return (
        f"\\begin{{table}}\n\\centering\n\\caption{{{title}}}\n"
        "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%\n"
        f"{tabular.rstrip()}}}\n\\end{{table}}"
    )


MARKDOWN = Format(_escape_markdown, _markdown_table, "*{}*", "**{}**", "<sup>{}</sup>")
TERMINAL = Format(
    _escape_markdown, _markdown_table, "*{}*", "**{}**", " ({})", origin=False
)
LATEX = Format(
    _escape_latex,
    _latex_table,
    r"\textit{{{}}}",
    r"\textbf{{{}}}",
    r"\textsuperscript{{{}}}",
)


def files_of(report: Report) -> dict[str, str]:
    """The files of a report by name; LaTeX has a ``table`` per grid, for ``\\input``."""
    packages = (
        "% needs \\usepackage{booktabs} and, for wide tables, \\usepackage{graphicx}"
    )
    return {
        "report.md": f"# {MARKDOWN.escape(report.title)}\n\n{MARKDOWN.body(report)}\n",
        "report.tex": f"{packages}\n\n{LATEX.body(report)}\n",
        "report.csv": report.frame().to_csv(index=False),
    }
