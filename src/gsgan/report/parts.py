"""The grids of a table: which runs, split and columns each shows, and its rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gsgan.report.cells import Column, Source
from gsgan.report.grid import NO_RUN, NOT_HAD, Cell, Grid, Row, common
from gsgan.report.mixing import data_name, lpips_name, protocols_differ, same_data
from gsgan.report.origin import changes, marks, provenance
from gsgan.report.paper import MEAN, PaperTable
from gsgan.report.scored import Run
from gsgan.report.spec import FLOOR, METRICS, PAINTED, RowSpec, TableSpec, heading
from gsgan.train.paper import NAME, clause

FLOOR_LABEL = "all background (floor)"
SPREAD = (
    "Mean ± sample standard deviation over seeds, as many as the column seeds says; one seed has "
    "no spread."
)
PAIRS = "Row − {} of the same seed; in brackets, how many of the seeds have the mean's sign."
SPLITS = {"novel_view": "held-out cameras", "novel_pose": "held-out poses"}


@dataclass(frozen=True)
class Part:
    """One grid's runs and columns.

    Args:
        spec: the table.
        runs: all that it shows.
        split: whose scores.
        title: its heading.
        columns: in order.
    """

    spec: TableSpec
    runs: Sequence[Run]
    split: str
    title: str
    columns: Sequence[Column]

    def source(self, row: RowSpec) -> Source:
        """The runs of a row."""
        runs = [run for run in self.runs if run.name == row.run]
        return Source(runs, self.split, row.variant)

    @property
    def rows(self) -> list[RowSpec]:
        """The table's rows; where it does not fix them, those that have something to show."""
        rows = self.spec.row_specs(sorted({run.name for run in self.runs}))
        if self.spec.rows is not None:
            return rows
        return [r for r in rows if any(x.of(self.split, r.variant) for x in self.source(r).runs)]

    @property
    def reference(self) -> Source | None:
        """What the rows are compared with, where it is there."""
        if self.spec.reference is None:
            return None
        source = self.source(RowSpec(self.spec.reference, variant=PAINTED))
        return source if source.runs else None


def groups(spec: TableSpec, runs: Sequence[Run]) -> list[list[Run]]:
    """All runs in one, or those of each data set and protocol in one of their own."""
    if not spec.apart:
        return [list(runs)]
    found: list[list[Run]] = []
    for run in runs:
        home = next((group for group in found if _alike(spec, group[0], run)), None)
        if home is None:
            found.append([run])
        else:
            home.append(run)
    return found


def _alike(spec: TableSpec, a: Run, b: Run) -> bool:
    if not same_data(a, b) or a.protocol != b.protocol:
        return False
    both = [s for s in spec.splits if a.protocol_record(s) and b.protocol_record(s)]
    return not any(protocols_differ(a, b, split) for split in both)


def parts(spec: TableSpec, runs: Sequence[Run]) -> list[Part]:
    """The grids of one group of runs, those that have a score to show."""
    found = []
    for split in spec.splits:
        told = f"{split} ({SPLITS[split]})" if split in SPLITS else split
        if spec.apart:
            told = f"{_origin(runs)}: {told}"
        if spec.subjects is None:
            columns = [Column(_heading(m, runs, split), m) for m in spec.metrics]
            found.append(Part(spec, runs, split, told, columns))
            continue
        for metric in spec.metrics:
            columns = [Column(s, metric, s) for s in spec.subjects]
            columns.append(Column(MEAN, metric, MEAN, tuple(spec.subjects)))
            title = f"{_heading(metric, runs, split)}, {told}"
            found.append(Part(spec, runs, split, title, columns))
    return [part for part in found if _scored(part)]


def _scored(part: Part) -> bool:
    tables = (run.scores.get(part.split, {}).values() for run in part.runs)
    return any(scores["images"] for variants in tables for scores in variants)


def _origin(runs: Sequence[Run]) -> str:
    data, found = common(map(data_name, runs)), runs[0].data.get("fingerprint")
    protocol = common(f"protocol {run.protocol}" if run.protocol else "no protocol" for run in runs)
    return f"{data}{f' [{found}]' if found else ''}, {protocol}"


def _heading(metric: str, runs: Sequence[Run], split: str) -> str:
    if not metric.startswith("lpips"):
        return heading(metric)
    named = common(lpips_name(run, split) or "" for run in runs)
    if metric == "lpips_person" and named:  # of the box, whatever region the protocol's LPIPS has
        named = f"{named.split(' mask crop')[0]} in box"
    return f"{named} {METRICS[metric].better}" if named else heading(metric)


def grids(part: Part, paper: PaperTable | None) -> list[Grid]:
    """The scores, and how rows differ from the reference.

    Args:
        part: what is shown.
        paper: figures that may stand beside it, or None.
    """
    rows, printed = [], _paper_rows(part, paper)
    for spec in part.rows:
        row = _row(part, spec)
        rows.append(row if paper is None else beside_the_paper(row, spec, part.source(spec).runs))
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
    seeds = [len(column.of(source.runs)) for column in part.columns if not column.subjects]
    origin = provenance(source.runs, seeds)
    if not source.runs:
        blank = [Cell(NO_RUN, {"n": 0}) for _ in part.columns]
        return Row(spec.title, blank, origin, notes=("no scored run",))
    cells = [source.cell(column) for column in part.columns]
    return Row(spec.title, cells, origin, notes=notes)


def beside_the_paper(row: Row, spec: RowSpec, runs: Sequence[Run]) -> Row:
    """A row that stands beside the paper's figures: named as the paper's method where all of its
    runs are, else with a note that says in what they are not."""
    departures = [run.departures() for run in runs]
    if not departures:
        return row
    if None in departures:
        return replace(row, notes=(*row.notes, "no config tells whether it is experiment=paper"))
    if found := next((keys for keys in departures if keys), None):
        return replace(row, notes=(*row.notes, clause(found)))
    whole = (spec.run, spec.variant) == ("full", PAINTED)
    return replace(row, label=NAME if whole else f"{NAME}, {row.label}")


def _floor(part: Part) -> Row:
    """The all-background picture: one for all runs, since all are of the same data."""
    of = {str(run.data.get("root")): run for run in part.runs if run.of(part.split, FLOOR)}
    source = Source([replace(run, seed=None) for run in of.values()], part.split, FLOOR)
    _, *where = provenance(part.runs, [])
    cells = [source.cell(column) for column in part.columns]
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
        if pairs := [cell.numbers["n"] for cell in cells if cell.numbers["n"]]:
            both = [*source.runs, *part.reference.runs]
            rows.append(Row(spec.title, cells, provenance(both, pairs)))
    return rows
