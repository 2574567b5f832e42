"""A report in Markdown."""

from __future__ import annotations

import re

from gsgan.report.grid import Grid, Report, Row, footnotes
from gsgan.utils.pages import markdown as table


def page(report: Report) -> str:
    """The whole page."""
    runs = f"## {_escape(report.runs.title)}\n\n{_grid(report.runs, {})}"
    return f"# {_escape(report.title)}\n\n{block(report)}\n\n{runs}\n"


def block(report: Report) -> str:
    """All but the title and the list of runs: what another page shows."""
    notes = footnotes(report.grids)
    parts = [f"**{_escape(grid.title)}**\n\n{_grid(grid, notes)}" for grid in report.grids]
    if notes:
        parts.append("\n".join(f"- {letter}: {_escape(note)}" for note, letter in notes.items()))
    if report.remarks:
        parts.append("\n".join(_escape(remark) for remark in report.remarks))
    if report.left_out:
        told = [f"- `{folder}`: {_escape(reason)}" for folder, reason in report.left_out]
        parts.append("\n".join(["Left out:", "", *told]))
    return "\n\n".join(parts)


def _grid(grid: Grid, notes: dict[str, str]) -> str:
    header = [grid.first, *grid.columns, *grid.provenance]
    text = table([_escape(name) for name in header], [_row(row, notes) for row in grid.rows])
    remarks = "\n".join(_escape(remark) for remark in grid.remarks)
    return f"{text}\n\n{remarks}" if remarks else text


def _row(row: Row, notes: dict[str, str]) -> list[str]:
    cells = [
        _escape(cell.text) + _marks([notes[note] for note in cell.notes]) for cell in row.cells
    ]
    label = _escape(row.label)
    label = f"*{label}*" if row.kind != "run" else label
    label += _marks([notes[note] for note in row.notes])
    return [label, *cells, *map(_escape, row.provenance)]


def _marks(letters: list[str]) -> str:
    return f"<sup>{' '.join(letters)}</sup>" if letters else ""


def _escape(text: str) -> str:
    """Text without anything that Markdown or HTML would act on; bars are the table's matter."""
    text = re.sub(r"([\\`*\[\]<>~$])", r"\\\1", text.replace("&", "&amp;"))
    return re.sub(r"(?<!\w)_|_(?!\w)", r"\\_", text)
