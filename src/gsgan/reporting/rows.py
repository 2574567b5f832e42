"""Grids of a part: rows of runs, of the paper, of the floor, and the differences between rows."""

from __future__ import annotations

from dataclasses import replace

from gsgan.reporting.cells import Source
from gsgan.reporting.grid import NO_RUN, NOT_HAD, Cell, Grid, Row, common
from gsgan.reporting.origin import changes, marks, provenance
from gsgan.reporting.paper import PaperTable
from gsgan.reporting.parts import Part
from gsgan.reporting.spec import FLOOR, PAINTED, RowSpec

FLOOR_LABEL = "all background (floor)"
SPREAD = (
    "Mean ± sample standard deviation over seeds, as many as the column seeds says; one seed has "
    "no spread."
)
PAIRS = "Row − {} of the same seed; in brackets, how many of the seeds have the mean's sign."


def grids(part: Part, paper: PaperTable | None) -> list[Grid]:
    """The scores, and how rows differ from the reference.

    Args:
        part: what is shown.
        paper: figures that may stand beside it, or None.
    """
    rows, printed = [], _paper_rows(part, paper)
    for spec in part.rows:
        rows.append(_row(part, spec))
        if spec.variant == PAINTED:
            rows += printed.pop(spec.run, [])
    rows += [row for left in printed.values() for row in left]
    rows.append(_floor(part))
    headings = [column.heading for column in part.columns]
    found = [_without_empty(Grid(part.title, headings, rows, remarks=(SPREAD,)), told=True)]
    if differences := _differences(part):
        title = f"{part.title}: difference from {part.spec.reference}"
        remark = PAIRS.format(part.spec.reference)
        grid = Grid(title, headings, differences, remarks=(remark,))
        found.append(_without_empty(grid, told=False))
    return found


def _without_empty(grid: Grid, *, told: bool) -> Grid:
    """Without the columns that no row but the floor has; ``told``: named below with the reason."""
    rows = [row for row in grid.rows if row.kind != "floor"]
    kept = [
        i
        for i in range(len(grid.columns))
        if any(row.cells[i].numbers.keys() & {"mean", "paper"} for row in rows)
    ]
    if not kept:
        return grid
    remarks = list(grid.remarks)
    for i in sorted(set(range(len(grid.columns))) - set(kept)) if told else ():
        why = common(n.removeprefix("n/a: ") for row in rows for n in row.cells[i].notes)
        remarks.append(f"Not shown: {grid.columns[i]} ({why}).")
    return replace(
        grid,
        columns=[grid.columns[i] for i in kept],
        rows=[replace(row, cells=[row.cells[i] for i in kept]) for row in grid.rows],
        remarks=tuple(remarks),
    )


def _row(part: Part, spec: RowSpec) -> Row:
    source = part.source(spec)
    notes = marks(source.runs, part.split)
    if part.reference is not None and spec.variant == PAINTED:
        notes += changes(source.runs, part.reference.runs, str(part.spec.reference))
    origin = provenance(source.runs, part.columns)
    if not source.runs:
        blank = [Cell(NO_RUN, {"n": 0}) for _ in part.columns]
        return Row(spec.title, blank, origin, notes=("no scored run",))
    cells = [source.cell(column) for column in part.columns]
    return Row(spec.title, cells, origin, notes=notes)


def _floor(part: Part) -> Row:
    """The all-background picture: one for all runs, since all are of the same data."""
    cells = []
    for column in part.columns:
        of = {str(r.data.get("root")): r for r in part.runs if r.of(part.split, FLOOR)}
        cells.append(Source(list(of.values()), part.split, FLOOR).cell(column))
    _, *where = provenance(part.runs, part.columns)
    return Row(FLOOR_LABEL, cells, (NOT_HAD, *where), "floor")


def _paper_rows(part: Part, paper: PaperTable | None) -> dict[str, list[Row]]:
    """The paper's rows by the model they belong to."""
    found: dict[str, list[Row]] = {}
    if paper is None:
        return found
    columns = [(column.subject or str(paper.subject), column.metric) for column in part.columns]
    for held in paper.rows:
        found.setdefault(held.beside or held.label, []).append(paper.row(held, columns))
    return found


def _differences(part: Part) -> list[Row]:
    """A row for every one that has a seed in common with the reference."""
    if part.reference is None:
        return []
    rows = []
    for spec in part.rows:
        if spec.run == part.spec.reference and spec.variant == PAINTED:
            continue
        source = part.source(spec)
        cells = [source.difference(column, part.reference) for column in part.columns]
        if any(cell.numbers["n"] for cell in cells):
            rows.append(Row(spec.title, cells, provenance(source.runs, part.columns)))
    return rows
