"""Tables as Markdown and LaTeX."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import pandas as pd

from gsgan.utils.pages import markdown as markdown_table

NOT_HAD = "n/a"
NO_RUN = "–"
ORIGIN = ("seeds", "data", "protocol", "commit")  # columns after the scores


@dataclass(frozen=True)
class Cell:
    """One value of a table."""

    text: str
    mean: float | None = None  # over seeds
    spread: float | None = None  # standard deviation over seeds
    notes: tuple[str, ...] = ()  # printed below the table
    best: bool = False  # of its column


@dataclass(frozen=True)
class Row:
    """One row of a table."""

    label: str
    cells: Sequence[Cell]  # one per column
    origin: Sequence[str] = ()  # a text for each of `ORIGIN`, or none
    # ``floor`` for the all-background image, ``paper`` for numbers that the paper prints.
    kind: Literal["run", "floor", "paper"] = "run"
    notes: tuple[str, ...] = ()  # on the whole row


@dataclass(frozen=True)
class Grid:
    """One table."""

    title: str
    columns: Sequence[str]  # headings of the cells
    rows: Sequence[Row]
    remarks: Sequence[str] = ()  # below the table


@dataclass(frozen=True)
class Report:
    """All tables, and the runs that were left out."""

    title: str
    grids: Sequence[Grid]
    # reasons by folder
    left_out: Mapping[str, str] = field(default_factory=dict)

    def notes(self) -> dict[str, str]:
        """A number for every note, in the order of appearance."""
        # Equal notes share the number of the first one.
        notes: dict[str, str] = {}
        for grid in self.grids:
            for row in grid.rows:
                for held in (row.notes, *(cell.notes for cell in row.cells)):
                    for note in held:
                        notes.setdefault(note, str(len(notes) + 1))
        return notes

    def frame(self) -> pd.DataFrame:
        """One row per value: table, row, column, text, mean and spread."""
        values = []
        for grid in self.grids:
            for row in grid.rows:
                for column, cell in zip(grid.columns, row.cells, strict=True):
                    place = (grid.title, row.label, column)
                    values.append((*place, cell.text, cell.mean, cell.spread))
        columns = ["table", "row", "column", "text", "mean", "spread"]
        return pd.DataFrame(values, columns=columns)


def join_unique(texts: Iterable[str | None]) -> str:
    """The texts that are not empty, each once, joined by commas."""
    return ", ".join(dict.fromkeys(filter(None, texts)))


@dataclass(frozen=True)
class Format:
    """The parts of one text format; ``italic``, ``bold`` and ``raised`` are patterns."""

    escape: Callable[[str], str]
    # of title, header and rows
    table: Callable[[str, list[str], list[list[str]]], str]
    italic: str
    bold: str
    raised: str  # for the numbers of notes
    origin: bool = True  # whether tables have the columns `ORIGIN`

    def grid(self, grid: Grid, notes: Mapping[str, str]) -> str:
        """One table with its remarks."""

        def cell(text: str, marks: Sequence[str], pattern: str) -> str:
            written = pattern.format(self.escape(text))
            if marks:
                written += self.raised.format(
                    " ".join(notes[mark] for mark in marks)
                )
            return written

        # The best values are bold; labels of rows that are not runs are italic.
        with_origin = self.origin and any(row.origin for row in grid.rows)
        rows = []
        for row in grid.rows:
            # Rows that are no runs are in italics, best cells are bold.
            pattern = "{}" if row.kind == "run" else self.italic
            line = [cell(row.label, row.notes, pattern)]
            for c in row.cells:
                line.append(
                    cell(c.text, c.notes, self.bold if c.best else "{}")
                )
            if with_origin:
                line += map(self.escape, row.origin)
            rows.append(line)

        columns = ["", *grid.columns]
        if with_origin:
            columns += ORIGIN
        header = list(map(self.escape, columns))
        table = self.table(self.escape(grid.title), header, rows)
        return "\n\n".join([table, *map(self.escape, grid.remarks)])

    def body(self, report: Report) -> str:
        """All but the title."""
        notes = report.notes()
        # Notes and reasons are below all tables.
        parts = [self.grid(grid, notes) for grid in report.grids]
        for note, number in notes.items():
            parts.append(self.escape(f"{number}: {note}"))
        for folder, reason in report.left_out.items():
            parts.append(self.escape(f"Left out: {folder}: {reason}"))
        return "\n\n".join(parts)


def _escape_markdown(text: str) -> str:
    # An underscore within a word is plain text in Markdown.
    text = re.sub(r"([\\`*\[\]<>~$])", r"\\\1", text.replace("&", "&amp;"))
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", text)


def _markdown_table(
    title: str, header: list[str], rows: list[list[str]]
) -> str:
    return f"**{title}**\n\n{markdown_table(header, rows)}"


# After \\ the letters [ ] * would be an argument.
LATEX_LETTERS = str.maketrans(
    {c: f"\\{c}" for c in "{}$&#%_"}
    | {c: f"{{{c}}}" for c in "[]*"}
    | {
        "\\": r"\textbackslash{}",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        "\n": " ",
        "±": r"$\pm$",
        "−": "$-$",
        "→": r"$\rightarrow$",
        "↑": r"$\uparrow$",
        "↓": r"$\downarrow$",
        "Ψ": r"$\Psi$",
        "…": r"\ldots{}",
        "–": "--",
        "²": "$^2$",
    }
)


def _escape_latex(text: str) -> str:
    """Text for LaTeX; letters that pdfLaTeX's fonts lack are written as their code point."""
    written = ""
    for letter in text.translate(LATEX_LETTERS):
        written += (
            letter if letter < "\u0180" else f"{{[}}U+{ord(letter):04X}{{]}}"
        )
    return written


def _latex_table(title: str, header: list[str], rows: list[list[str]]) -> str:
    """A ``table`` that is no wider than the text."""
    # The first column has the labels, the others have numbers.
    alignment = "l".ljust(len(header), "r")
    frame = pd.DataFrame(rows, columns=header)
    tabular = frame.to_latex(index=False, escape=False, column_format=alignment)
    return (
        f"\\begin{{table}}\n\\centering\n\\caption{{{title}}}\n"
        "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%\n"
        f"{tabular.rstrip()}}}\n\\end{{table}}"
    )


MARKDOWN = Format(
    escape=_escape_markdown,
    table=_markdown_table,
    italic="*{}*",
    bold="**{}**",
    raised="<sup>{}</sup>",
)
TERMINAL = replace(MARKDOWN, raised=" ({})", origin=False)
LATEX = Format(
    escape=_escape_latex,
    table=_latex_table,
    italic=r"\textit{{{}}}",
    bold=r"\textbf{{{}}}",
    raised=r"\textsuperscript{{{}}}",
)


def files_of(report: Report) -> dict[str, str]:
    """The files of a report by name; LaTeX has a ``table`` per grid, for ``\\input``."""
    # Wide tables are scaled to the width of the text.
    packages = "% needs \\usepackage{booktabs} and, for wide tables, \\usepackage{graphicx}"
    return {
        "report.md": f"# {MARKDOWN.escape(report.title)}\n\n{MARKDOWN.body(report)}\n",
        "report.tex": f"{packages}\n\n{LATEX.body(report)}\n",
        "report.csv": report.frame().to_csv(index=False),
    }
