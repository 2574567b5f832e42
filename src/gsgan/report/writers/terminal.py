"""A report on the terminal."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from gsgan.report.grid import NO_RUN, Grid, Report, footnotes

STYLES = {"run": "", "floor": "dim", "paper": "italic"}


def print_report(report: Report, console: Console) -> None:
    """Every grid, the notes, and last, nearest to the prompt, what was left out."""
    notes = footnotes(report.grids)
    for grid in report.grids:
        console.print(_table(grid, notes))
        for remark in (*grid.remarks, _origin(grid)):
            if remark:
                console.print(Text(f"  {remark}", "dim"))
    for note, letter in notes.items():
        console.print(Text(f"  {letter}: {note}"))
    for remark in report.remarks:
        console.print(Text(f"  {remark}"))
    for folder, reason in report.left_out:
        console.print(Text(f"left out: {folder}: {reason}", "yellow"), soft_wrap=True)


def _table(grid: Grid, notes: dict[str, str]) -> Table:
    """The scores alone; `_origin` is told below, where it does not take their width."""
    drawn = Table(
        title=Text(grid.title),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    drawn.add_column(Text(grid.first), no_wrap=True)
    for name in grid.columns:
        drawn.add_column(Text(name), justify="right", overflow="fold")
    for row in grid.rows:
        cells = (_marked(cell.text, cell.notes, notes) for cell in row.cells)
        drawn.add_row(_marked(row.label, row.notes, notes), *cells, style=STYLES[row.kind])
    return drawn


def _origin(grid: Grid) -> str:
    """Where the rows with runs are from, else the paper's: what all share once, else by row."""
    rows = [row for row in grid.rows if row.kind == "run" and NO_RUN not in row.provenance]
    rows = rows or [row for row in grid.rows if row.kind == "paper"]
    told = []
    for i, name in enumerate(grid.provenance):
        labels: dict[str, list[str]] = {}
        for row in rows:
            labels.setdefault(row.provenance[i], []).append(row.label)
        shared = len(labels) == 1
        texts = [v if shared else f"{v} ({', '.join(held)})" for v, held in labels.items()]
        told.append(f"{name}: {', '.join(texts)}")
    return "; ".join(told)


def _marked(text: str, told: tuple[str, ...], notes: dict[str, str]) -> Text:
    letters = ",".join(notes[note] for note in told)
    return Text.assemble(text, (f" {letters}" if letters else "", "cyan"))
