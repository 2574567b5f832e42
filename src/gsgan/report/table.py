"""A table of runs: one tidy frame of scores, statistics over its seeds, rows and grids."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsgan.report.comparable import (
    check_column,
    check_row,
    differing,
    lpips_name,
)
from gsgan.report.paper import PaperTable
from gsgan.report.runs import Run, by_settings
from gsgan.report.scores import Values, difference, mean_cell, scores
from gsgan.report.spec import (
    FLOOR,
    MEAN,
    METRICS,
    PAINTED,
    RowSpec,
    TableSpec,
    heading,
    subject_of,
    written,
)
from gsgan.report.write import NO_RUN, NOT_HAD, Cell, Grid, Report, Row, common
from gsgan.train.paper import NAME, clause
from gsgan.utils.errors import ConfigError

UNKNOWN = "unknown"
MOST_SETTINGS = 6  # named in a note
FLOOR_LABEL = "all background (floor)"
SPREAD = (
    "Mean ± sample standard deviation over seeds, as many as the column seeds says; one seed has "
    "no spread."
)
PAIRS = "Row − {} of the same seed; in brackets, how many of the seeds have the mean's sign."
SPLITS = {"novel_view": "held-out cameras", "novel_pose": "held-out poses"}


@dataclass(frozen=True)
class Part:
    """One grid: a split's scores of runs that may stand together.

    Args:
        spec: the table.
        runs: all that it shows.
        split: whose scores.
        metric: the one shown where subjects are the columns, else None.
    """

    spec: TableSpec
    runs: Sequence[Run]
    split: str
    metric: str | None = None

    @property
    def columns(self) -> dict[str, str]:
        """Headings of the columns: metrics, or subjects and their mean."""
        if self.metric is None:
            return {metric: self._heading(metric) for metric in self.spec.metrics}
        return {column: column for column in (*(self.spec.subjects or ()), MEAN)}

    @property
    def title(self) -> str:
        """Of the grid."""
        text = f"{self.split} ({SPLITS[self.split]})" if self.split in SPLITS else self.split
        if self.spec.apart:
            run = self.runs[0]
            data = f"{run.data_name} [{run.data.get('fingerprint')}]"
            text = f"{data}, protocol {run.protocol_name}: {text}"
        return text if self.metric is None else f"{self._heading(self.metric)}, {text}"

    def _heading(self, metric: str) -> str:
        """With LPIPS' backbone and region, as far as runs have it."""
        named = common(lpips_name(run, self.split) or "" for run in self.runs)
        if not metric.startswith("lpips") or not named:
            return heading(metric)
        if metric == "lpips_person":  # of the box, whatever region the protocol's LPIPS has
            named = f"{named.split(' mask crop')[0]} in box"
        return f"{named} {METRICS[metric].better}"

    def of(self, name: str) -> list[Run]:
        """The runs of a model or method."""
        return [run for run in self.runs if run.name == name]

    def runs_of(self, column: str) -> list[Run]:
        """The runs that a column shows."""
        if self.metric is None or column == MEAN:
            return list(self.runs)
        return [run for run in self.runs if subject_of(run.data.get("root"), [column])]

    @property
    def rows(self) -> list[RowSpec]:
        """The table's rows; where it does not fix them, those that have a score."""
        rows = self.spec.row_specs(sorted({run.name for run in self.runs}))
        if self.spec.rows is not None:
            return rows
        return [r for r in rows if any(run.of(self.split, r.variant) for run in self.of(r.run))]

    def check(self, allow_dirty: bool) -> None:
        """Raises ConfigError where a column or a row would mix what does not belong together."""
        where = f"table {self.spec.name}, {self.split}"
        for column in self.columns:
            runs, mean = self.runs_of(column), column == MEAN
            check_column(runs, self.split, where, allow_dirty=allow_dirty, subjects=mean)
            for name in set() if mean else {run.name for run in runs}:
                check_row([run for run in runs if run.name == name], self.split, where)


def build(
    spec: TableSpec,
    runs: Sequence[Run],
    left_out: Mapping[Path, str],
    paper: PaperTable | None,
    *,
    allow_dirty: bool = False,
) -> Report:
    """A table with everything that belongs below it.

    Args:
        spec: the table.
        runs: all that can be read.
        left_out: reasons by folder for those that cannot.
        paper: the numbers that the paper prints for it.
        allow_dirty: let runs of uncommitted code stand beside others.

    Raises:
        ConfigError: when runs in one column or row differ in more than they may, or no run is left.
    """
    taken, unfit = _select(spec, runs)
    left_out = {**left_out, **unfit}
    if not taken:
        reasons = "; ".join(f"{folder}: {reason}" for folder, reason in left_out.items())
        raise ConfigError(f"table {spec.name}: no scored run is left for it ({reasons})")
    metrics = [None] if spec.subjects is None else spec.metrics
    parts = [
        Part(spec, group, split, metric)
        for group in _groups(spec, taken)
        for split in spec.splits
        for metric in metrics
        if any(run.images(split) for run in group)
    ]
    if not parts:
        names = " or ".join(spec.splits)
        raise ConfigError(f"table {spec.name}: no run has scored an image of {names}")
    for part in parts:
        part.check(allow_dirty)
    folders = [*(run.folder for run in taken), *left_out]
    shared = os.path.commonpath([folder.parent for folder in folders])
    names = {folder: os.path.relpath(folder, shared) for folder in folders}
    return Report(
        spec.name,
        spec.title,
        _grids(parts, paper),
        _runs_grid(taken, names),
        list(_remarks(spec, taken)),
        [(names[folder], reason) for folder, reason in left_out.items()],
    )


def _select(spec: TableSpec, runs: Sequence[Run]) -> tuple[list[Run], dict[Path, str]]:
    """The runs that the table has a place for, and why the others have none.

    Raises:
        ConfigError: on a run of another data set than the table's.
    """
    taken, unfit = [], {}
    rows = None if spec.rows is None else {row.run for row in spec.rows}
    for run in runs:
        if spec.data is not None and run.data.get("name") != spec.data:
            raise ConfigError(
                f"table {spec.name} is of {spec.data}, but {run} is of {run.data_name}; leave it "
                "out of runs, or use table=plain"
            )
        if spec.subjects and subject_of(run.data.get("root"), spec.subjects) is None:
            names = ", ".join(spec.subjects)
            unfit[run.folder] = f"its subject is none of {names} ({run.data_name})"
        elif rows is not None and run.name not in rows:
            unfit[run.folder] = f"table {spec.name} has no row for {run.name}"
        else:
            taken.append(by_settings(run, spec.by or ()))
    return taken, unfit


def _groups(spec: TableSpec, runs: Sequence[Run]) -> list[list[Run]]:
    """All runs in one group, or with ``apart`` those of each data set and protocol."""
    found: dict[Any, list[Run]] = {}
    for run in runs:
        key = (*map(str, run.data.values()), run.protocol_name) if spec.apart else None
        found.setdefault(key, []).append(run)
    return list(found.values())


def _grids(parts: Sequence[Part], paper: PaperTable | None) -> list[Grid]:
    """Those of every part, with the paper's numbers beside them where they may, else last."""
    if paper is None:
        return [grid for part in parts for grid in _part_grids(part, None)]
    why = [paper.why_apart(part.runs, part.split) for part in parts]
    found = [
        grid
        for part, reason in zip(parts, why, strict=True)
        for grid in _part_grids(part, None if reason else paper)
    ]
    if None not in why:
        nearest = [i for i, part in enumerate(parts) if part.split == paper.split] or [0]
        found.append(paper.grid(str(why[nearest[0]])))
    return found


def _part_grids(part: Part, paper: PaperTable | None) -> Iterator[Grid]:
    """The scores, and the differences from the reference.

    Args:
        part: what is shown.
        paper: numbers that may stand beside it, or None.
    """
    metrics = {column: part.metric or column for column in part.columns}
    values = scores(part.runs, part.split, metrics)
    printed = {} if paper is None else paper.beside(
        [(None if part.metric is None else c, m) for c, m in metrics.items()]
    )  # fmt: skip
    rows: list[Row] = []
    for spec in part.rows:
        cells = [mean_cell(m, values.get((spec.run, spec.variant, c))) for c, m in metrics.items()]
        rows.append(_row(part, spec, cells, beside_paper=paper is not None))
        if spec.variant == PAINTED:
            rows += printed.pop(spec.run, [])
    rows = _with_best([*rows, *(row for left in printed.values() for row in left)], metrics)
    floor = [mean_cell(m, values.get((FLOOR, FLOOR, c))) for c, m in metrics.items()]
    _, *origin = _origin(part.runs, [])
    rows.append(Row(FLOOR_LABEL, floor, (NOT_HAD, *origin), "floor"))
    headings = list(part.columns.values())
    yield _without_empty(Grid(part.title, headings, rows, (SPREAD,)), explain=True)
    if differences := list(_differences(part, values, metrics)):
        title = f"{part.title}: difference from {part.spec.reference}"
        remarks = (PAIRS.format(part.spec.reference),)
        yield _without_empty(Grid(title, headings, differences, remarks), explain=False)


def _row(part: Part, spec: RowSpec, cells: list[Cell], *, beside_paper: bool) -> Row:
    runs = part.of(spec.run)
    if not runs:
        cells = [Cell(NO_RUN, {"n": 0}) for _ in cells]
        return Row(spec.title, cells, ("0", NO_RUN, NO_RUN, NO_RUN), notes=("no scored run",))
    label, notes = spec.title, list(_marks(runs, part.split))
    reference = part.of(part.spec.reference or "")
    if reference and spec.variant == PAINTED and spec.run != part.spec.reference:
        notes += _changes(runs[0], reference[0])
    if beside_paper:
        departures = [run.departures() for run in runs]
        if None in departures:
            notes.append("no config says whether it is experiment=paper")
        elif found := next(filter(None, departures), None):
            notes.append(clause(found))
        else:
            whole = (spec.run, spec.variant) == ("full", PAINTED)
            label = NAME if whole else f"{NAME}, {label}"
    counts = [
        len([run for run in part.runs_of(c) if run in runs]) for c in part.columns if c != MEAN
    ]
    return Row(label, cells, _origin(runs, counts), notes=tuple(notes))


def _differences(part: Part, values: Values, metrics: Mapping[str, str]) -> Iterator[Row]:
    """A row for every row that has a seed in common with the reference."""
    name = str(part.spec.reference)
    for spec in part.rows:
        if (spec.run, spec.variant) == (name, PAINTED):
            continue
        pairs = [[values.get((*row, c)) for row in ((spec.run, spec.variant), (name, PAINTED))]
                 for c in metrics]  # fmt: skip
        cells = [difference(m, *pair) for m, pair in zip(metrics.values(), pairs, strict=True)]
        if counts := [cell.numbers["n"] for cell in cells if cell.numbers["n"]]:
            runs = [*part.of(spec.run), *part.of(name)]
            yield Row(spec.title, cells, _origin(runs, counts))


def _with_best(rows: Sequence[Row], metrics: Mapping[str, str]) -> list[Row]:
    """Marks the best of our rows in each column that several of them have."""
    rows = [replace(row, cells=list(row.cells)) for row in rows]
    for i, metric in enumerate(metrics.values()):
        better = METRICS[metric].better
        means = {
            place: row.cells[i].numbers["mean"]
            for place, row in enumerate(rows)
            if "mean" in row.cells[i].numbers
        }
        if len(means) < 2:
            continue
        losses = {k: {"↑": -v, "↓": v}.get(better, abs(v - 1)) for k, v in means.items()}
        best = written(metric, means[min(losses, key=lambda place: losses[place])])
        for place, mean in means.items():
            if written(metric, mean) == best:
                cells: Any = rows[place].cells
                cells[i] = replace(cells[i], best=True)
    return rows


def _without_empty(grid: Grid, *, explain: bool) -> Grid:
    """Without columns that only the floor has; ``explain``: with a remark that says why."""
    rows = [row for row in grid.rows if row.kind != "floor"]
    kept, remarks = [], list(grid.remarks)
    for i, name in enumerate(grid.columns):
        if any(row.cells[i].numbers.keys() & {"mean", "paper"} for row in rows):
            kept.append(i)
        elif explain:
            why = common(n.removeprefix("n/a: ") for row in rows for n in row.cells[i].notes)
            remarks.append(f"Not shown: {name} ({why}).")
    if not kept:
        return grid
    return replace(
        grid,
        columns=[grid.columns[i] for i in kept],
        rows=[replace(row, cells=[row.cells[i] for i in kept]) for row in grid.rows],
        remarks=tuple(remarks),
    )


def _origin(runs: Sequence[Run], counts: Sequence[int]) -> tuple[str, ...]:
    """Seeds (``counts``, one per column), data, protocol and commit of a row."""
    seeds = " to ".join(map(str, dict.fromkeys((min(counts), max(counts))))) if counts else ""
    data = common(run.data_name for run in runs)
    if len(roots := {run.data.get("root") for run in runs}) > 1:
        data = f"{runs[0].data['name']}, {len(roots)} subjects"
    protocol = common(run.protocol_name for run in runs)
    return seeds, data, protocol, common(run.commit for run in runs)


def _marks(runs: Sequence[Run], split: str) -> list[str]:
    """Marks (such as a stand-in perceptual loss) and departures that a row must carry."""
    found = []
    for run in runs:
        for held in run.scores.get(split, {}).values():
            found += [f"marked: {mark}" for mark in held.get("marks", [])]
        record = run.protocol(split) or {}
        found += [f"departs from {record['name']}: {d}" for d in record.get("departures", [])]
    return list(dict.fromkeys(found))


def _changes(run: Run, reference: Run) -> list[str]:
    """In which settings a run differs from the reference; parts of the model as a whole."""
    if run.settings is None or reference.settings is None:
        return []
    keys = [
        ".".join(key.split(".")[:2]) if key.startswith("model.") else key
        for key in differing(reference.settings, run.settings)
    ]
    found = list(dict.fromkeys(keys))
    text = ", ".join(found[:MOST_SETTINGS]) + (" …" if len(found) > MOST_SETTINGS else "")
    return [f"{run.name} differs from {reference.name} in {text or 'no setting'}"]


def _remarks(spec: TableSpec, runs: Sequence[Run]) -> Iterator[str]:
    commits, names = (sorted({getattr(run, key) for run in runs}) for key in ("commit", "name"))
    if len(commits) > 1:
        yield f"Runs are of several commits: {', '.join(commits)}."
    if spec.by and spec.reference is not None and spec.reference not in names:
        yield (
            f"No differences: no row is called {spec.reference}; table.reference='{names[0]}' "
            "compares with that row."
        )


def _runs_grid(runs: Sequence[Run], names: Mapping[Path, str]) -> Grid:
    """One row per run: where it came from."""
    header = ("version", "iterations", "train_seconds", "device", "torch", "date")
    rows = []
    for run in runs:
        held = [run.name, run.seed, run.data_name, run.data.get("fingerprint"), run.protocol_name]
        held += [run.commit, *(run.facts.get(key) for key in header)]
        cells = [Cell(UNKNOWN if text is None else str(text)) for text in held]
        rows.append(Row(names[run.folder], cells))
    columns = ("row", "seed", "data", "fingerprint", "protocol", "commit", *header)
    return Grid("Runs", columns, rows, first="folder")
