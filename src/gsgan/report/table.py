"""A table of runs: its rows and columns, and what belongs below it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from gsgan.report.comparable import check_column, check_row, differing, lpips_name
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

FLOOR_LABEL = "all background (floor)"
SPREAD = (
    "Mean ± sample standard deviation over seeds, as many as the column seeds says; one seed has "
    "no spread."
)
PAIRS = "Row − {} of the same seed; in brackets, how many of the seeds have the mean's sign."
SPLITS = {"novel_view": "held-out cameras", "novel_pose": "held-out poses"}
FACTS = ("version", "iterations", "train_seconds", "device", "torch", "date")


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
        """The metric of each column: metrics themselves, or subjects and their mean."""
        if self.metric is None:
            return {metric: metric for metric in self.spec.metrics}
        return dict.fromkeys([*(self.spec.subjects or ()), MEAN], self.metric)

    @property
    def title(self) -> str:
        """Of the grid."""
        text = f"{self.split} ({SPLITS[self.split]})" if self.split in SPLITS else self.split
        if self.spec.apart:
            run = self.runs[0]
            data = f"{run.data_name} [{run.data.get('fingerprint')}]"
            text = f"{data}, protocol {run.protocol()['name']}: {text}"
        return text if self.metric is None else f"{self.heading(self.metric)}, {text}"

    def heading(self, metric: str) -> str:
        """Of a metric, with LPIPS' backbone and region as far as runs have it."""
        named = common(lpips_name(run, self.split) or "" for run in self.runs)
        if not metric.startswith("lpips") or not named:
            return heading(metric)
        if metric == "lpips_person":  # of the box, whatever region the protocol's LPIPS has
            named = f"{named.split(' mask crop')[0]} in box"
        return f"{named} {METRICS[metric].better}"

    def of(self, name: str | None) -> list[Run]:
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
    unfit = {run.folder: why for run in runs if (why := _no_place(spec, run))}
    taken = [by_settings(run, spec.by or ()) for run in runs if run.folder not in unfit]
    left_out = {**left_out, **unfit}
    groups: dict[Any, list[Run]] = {}
    for run in taken:  # with apart, other data and protocols have grids of their own
        key = (str(run.data), run.protocol()["name"]) if spec.apart else None
        groups.setdefault(key, []).append(run)
    parts = [
        Part(spec, group, split, metric)
        for group in groups.values()
        for split in spec.splits
        for metric in ([None] if spec.subjects is None else spec.metrics)
        if any(run.images(split) for run in group)
    ]
    if not parts:
        reasons = "; ".join(f"{folder}: {reason}" for folder, reason in left_out.items())
        raise ConfigError(
            f"table {spec.name}: no run is left that has scored an image of "
            f"{' or '.join(spec.splits)} ({reasons or 'none left out'})"
        )
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


def _no_place(spec: TableSpec, run: Run) -> str | None:
    """Why the table has no place for a run.

    Raises:
        ConfigError: on a run of another data set than the table's.
    """
    if spec.data not in (None, run.data.get("name")):
        raise ConfigError(
            f"table {spec.name} is of {spec.data}, but {run} is of {run.data_name}; leave it out "
            "of runs, or use table=plain"
        )
    if spec.subjects and subject_of(run.data.get("root"), spec.subjects) is None:
        return f"its subject is none of {', '.join(spec.subjects)} ({run.data_name})"
    if spec.rows is not None and run.name not in {row.run for row in spec.rows}:
        return f"table {spec.name} has no row for {run.name}"
    return None


def _grids(parts: Sequence[Part], paper: PaperTable | None) -> list[Grid]:
    """Those of every part, with the paper's numbers beside them where they may, else last."""
    found: list[Grid] = []
    reasons: dict[str, str] = {}
    beside = False
    for part in parts:
        why = None if paper is None else paper.why_apart(part.runs, part.split)
        found += _part_grids(part, None if why else paper)
        beside = beside or why is None
        reasons.setdefault(part.split, why or "")
    if paper is not None and not beside:
        why = reasons.get(str(paper.split)) or next(iter(reasons.values()))
        found.append(paper.grid(why))
    return found


def _part_grids(part: Part, paper: PaperTable | None) -> Iterator[Grid]:
    """The scores, and the differences from the reference.

    Args:
        part: what is shown.
        paper: numbers that may stand beside it, or None.
    """
    columns = part.columns
    values = scores(part.runs, part.split, columns)
    subjects = [(None if part.metric is None else c, m) for c, m in columns.items()]
    printed = {} if paper is None else paper.beside(subjects)
    rows: list[Row] = []
    for spec in part.rows:
        cells = [mean_cell(m, values.get((spec.run, spec.variant, c))) for c, m in columns.items()]
        rows.append(_row(part, spec, cells, beside_paper=paper is not None))
        if spec.variant == PAINTED:
            rows += printed.pop(spec.run, [])
    rows = _with_best([*rows, *(row for left in printed.values() for row in left)], part)
    floor = [mean_cell(m, values.get((FLOOR, FLOOR, c))) for c, m in columns.items()]
    origin = (NOT_HAD, *_origin(part.runs, [])[1:])
    rows.append(Row(FLOOR_LABEL, floor, origin, "floor"))
    yield _without_empty(part, part.title, rows, SPREAD)
    if differences := list(_differences(part, values)):
        title = f"{part.title}: difference from {part.spec.reference}"
        yield _without_empty(part, title, differences, PAIRS.format(part.spec.reference))


def _row(part: Part, spec: RowSpec, cells: list[Cell], *, beside_paper: bool) -> Row:
    runs, reference = part.of(spec.run), part.of(part.spec.reference)
    if not runs:
        cells = [Cell(NO_RUN, {"n": 0}) for _ in cells]
        return Row(spec.title, cells, ("0", NO_RUN, NO_RUN, NO_RUN), notes=("no scored run",))
    label, notes = spec.title, list(_marks(runs, part.split))
    if reference and spec.variant == PAINTED and spec.run != part.spec.reference:
        notes += _changes(runs[0], reference[0])
    if beside_paper:  # named as the paper's method where all runs are
        departures = [run.departures() for run in runs]
        if None in departures:
            notes.append("no config says whether it is experiment=paper")
        elif found := next(filter(None, departures), None):
            notes.append(clause(found))
        else:
            whole = (spec.run, spec.variant) == ("full", PAINTED)
            label = NAME if whole else f"{NAME}, {label}"
    counts = [sum(run in runs for run in part.runs_of(c)) for c in part.columns if c != MEAN]
    return Row(label, cells, _origin(runs, counts), notes=tuple(notes))


def _differences(part: Part, values: Values) -> Iterator[Row]:
    """A row for every row that has a seed in common with the reference."""
    reference = (str(part.spec.reference), PAINTED)
    for spec in part.rows:
        row = (spec.run, spec.variant)
        cells = [
            difference(metric, values.get((*row, c)), values.get((*reference, c)))
            for c, metric in part.columns.items()
        ]
        counts = [cell.numbers["n"] for cell in cells if cell.numbers["n"]]
        if counts and row != reference:
            runs = [*part.of(spec.run), *part.of(part.spec.reference)]
            yield Row(spec.title, cells, _origin(runs, counts))


def _with_best(rows: Sequence[Row], part: Part) -> list[Row]:
    """Marks the best of our rows in each column that several of them have."""
    found = [list(row.cells) for row in rows]
    for i, metric in enumerate(part.columns.values()):
        sign = {"↑": -1, "↓": 1}.get(METRICS[metric].better)
        means = [cells[i].numbers["mean"] for cells in found if "mean" in cells[i].numbers]
        if len(means) < 2:
            continue
        best = min(means, key=lambda mean: abs(mean - 1) if sign is None else sign * mean)
        for cells in found:
            mean = cells[i].numbers.get("mean")
            equal = mean is not None and written(metric, mean) == written(metric, best)
            cells[i] = replace(cells[i], best=equal)
    return [replace(row, cells=cells) for row, cells in zip(rows, found, strict=True)]


def _without_empty(part: Part, title: str, rows: Sequence[Row], remark: str) -> Grid:
    """A grid without the columns that only the floor has, which a remark names with the reason."""
    subjects = part.metric is not None
    headings = [c if subjects else part.heading(c) for c in part.columns]
    shown = [row for row in rows if row.kind != "floor"]
    kept, remarks = [], [remark]
    for i, name in enumerate(headings):
        if any(row.cells[i].numbers.keys() & {"mean", "paper"} for row in shown):
            kept.append(i)
        elif len(shown) < len(rows):  # not below differences: it is below the scores
            why = common(n.removeprefix("n/a: ") for row in shown for n in row.cells[i].notes)
            remarks.append(f"Not shown: {name} ({why}).")
    kept = kept or list(range(len(headings)))
    rows = [replace(row, cells=[row.cells[i] for i in kept]) for row in rows]
    return Grid(title, [headings[i] for i in kept], rows, tuple(remarks))


def _origin(runs: Sequence[Run], counts: Sequence[int]) -> tuple[str, ...]:
    """Seeds (``counts``, one per column), data, protocol and commit of a row."""
    seeds = " to ".join(map(str, dict.fromkeys((min(counts), max(counts))))) if counts else ""
    data = common(run.data_name for run in runs)
    if len(roots := {run.data.get("root") for run in runs}) > 1:
        data = f"{runs[0].data['name']}, {len(roots)} subjects"
    protocol = common(run.protocol()["name"] for run in runs)
    return seeds, data, protocol, common(run.commit for run in runs)


def _marks(runs: Sequence[Run], split: str) -> list[str]:
    """Marks (such as a stand-in perceptual loss) and departures that a row must carry."""
    found = []
    for run in runs:
        for held in run.scores.get(split, {}).values():
            found += [f"marked: {mark}" for mark in held.get("marks", [])]
        record = run.protocol(split)
        found += [f"departs from {record['name']}: {d}" for d in record.get("departures", [])]
    return list(dict.fromkeys(found))


def _changes(run: Run, reference: Run) -> list[str]:
    """In which settings a run differs from the reference; parts of the model as a whole."""
    if run.settings is None or reference.settings is None:
        return []
    keys = differing(reference.settings, run.settings)
    found = dict.fromkeys(
        ".".join(key.split(".")[:2]) if key.startswith("model.") else key for key in keys
    )
    text = ", ".join(list(found)[:6]) + (" …" if len(found) > 6 else "")
    return [f"{run.name} differs from {reference.name} in {text or 'no setting'}"]


def _remarks(spec: TableSpec, runs: Sequence[Run]) -> Iterator[str]:
    commits, names = (sorted({getattr(run, key) for run in runs}) for key in ("commit", "name"))
    if len(commits) > 1:
        yield f"Runs are of several commits: {', '.join(commits)}."
    if spec.by and spec.reference is not None and spec.reference not in names:
        example = f"table.reference='{names[0]}'"
        yield f"No differences: no row is called {spec.reference}; set for example {example}."


def _runs_grid(runs: Sequence[Run], names: Mapping[Path, str]) -> Grid:
    """One row per run: where it came from."""
    rows = []
    for run in runs:
        held = [run.name, run.seed, run.data_name, run.data.get("fingerprint")]
        held += [run.protocol()["name"], run.commit, *(run.facts.get(key) for key in FACTS)]
        cells = [Cell("unknown" if text is None else str(text)) for text in held]
        rows.append(Row(names[run.folder], cells))
    columns = ("row", "seed", "data", "fingerprint", "protocol", "commit", *FACTS)
    return Grid("Runs", columns, rows)
