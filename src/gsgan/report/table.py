"""Tables of ``runs``: rows and columns, statistics over seeds, and notes."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
from rich.markdown import Markdown

from gsgan.metrics.names import BOX_METRICS, FLOOR_VARIANT, FULL, METRICS, SPLAT
from gsgan.report.paper import PaperTable, read_paper
from gsgan.report.runs import (
    DATA,
    NAME,
    ScoredRun,
    by_settings,
    check_same,
    find_runs,
    read_runs,
)
from gsgan.report.spec import (
    MEAN,
    RowSpec,
    TableSpec,
    format_value,
)
from gsgan.report.write import (
    NO_RUN,
    NOT_HAD,
    TERMINAL,
    Cell,
    Grid,
    Report,
    Row,
    files_of,
    join_unique,
)
from gsgan.utils.config import CommandOptions
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically
from gsgan.utils.frame_files import natural_order

FLOOR_LABEL = "all background (floor)"
SPREAD_REMARK = (
    "Mean ± sample standard deviation over seeds, as many as the column seeds says; one seed has "
    "no spread. In brackets: standard deviation over poses of the mean of their images."
)
SPLIT_TITLES = {
    "novel_view": " (held-out cameras)",
    "novel_pose": " (held-out poses)",
}
# values of a protocol that differ by subject
PER_SUBJECT = ("subject", "train_frames", "test_frames")
UNCOMMITTED = "uncommitted changes of the code (allow_dirty=true allows them)"
NO_SEED = "None"  # of predictions and of the all-background image
NO_MEAN = "no mean over subjects: not all have scores of these seeds"


@dataclass(frozen=True)
class Part:
    """One grid: the scores of one split."""

    spec: TableSpec
    runs: Sequence[ScoredRun]
    split: str
    metric: str | None = None  # the only one, if subjects are the columns

    @property
    def columns(self) -> dict[str, str]:
        """The metric of each column: metrics themselves, or subjects and their mean."""
        if self.metric is None:
            metrics = self.spec.metrics
            return dict(zip(metrics, metrics, strict=True))
        return dict.fromkeys([*(self.spec.subjects or ()), MEAN], self.metric)

    def heading(self, metric: str) -> str:
        """The heading of a metric; LPIPS with the input of its network, if runs tell it."""
        # Inputs of LPIPS differ between protocols.
        name = METRICS[metric].name
        described = join_unique(
            run.first_value("lpips_input", self.split) for run in self.runs
        )
        if metric.startswith("lpips") and described:
            name = f"{name} {described}"
        if metric in self.spec.times_1000:
            name = f"{name} ×1000"
        return f"{name} {METRICS[metric].better}".rstrip()

    def write_value(self, metric: str, value: float) -> str:
        """A value of this table, with the metric's digits."""
        return format_value(
            metric, value, times_1000=metric in self.spec.times_1000
        )

    def of(self, name: str | None, column: str = MEAN) -> list[ScoredRun]:
        """The runs of a model or method (None: of all) that a column shows."""
        # A column of a subject shows that subject's runs only.
        shown = []
        for run in self.runs:
            if name is not None and run.name != name:
                continue
            if self.metric is None or column == MEAN or run.is_of([column]):
                shown.append(run)
        return shown

    @property
    def names(self) -> list[str]:
        """The names of models and methods; the full model is first."""
        names = {run.name for run in self.runs}
        return sorted(
            names, key=lambda name: (name != "full", natural_order(name))
        )

    @property
    def rows(self) -> list[RowSpec]:
        """The table's rows; if it does not fix them, those that have a score."""
        if self.spec.rows is not None:
            return list(self.spec.rows)

        # Step I's colour is named as such, the final image has the model's name.
        rows = []
        for name in self.names:
            for variant in self.spec.variants:
                label = f"{name}: Step I's colour" if variant == SPLAT else None
                if any(run.of(self.split, variant) for run in self.of(name)):
                    rows.append(RowSpec(name, label, variant))
        return rows

    @cached_property
    def scores(self) -> pd.DataFrame:
        """One row per run, variant and column: ``name variant column seed value note poses``.

        The all-background image is of the data, not of a model or seed, so it has one row per
        column, without a name.
        """
        # Every run has three variants, whether they were scored or not.
        rows = []
        for column, metric in self.columns.items():
            if column == MEAN:
                continue
            for run in self.of(None, column):
                # Values that lack carry the reason as a note.
                for variant in (FULL, SPLAT, FLOOR_VARIANT):
                    value, note = _value(run, self.split, variant, metric)
                    held = run.of(self.split, variant)
                    poses = held.get(f"{metric}_over_poses")
                    seed = str(run.seed)
                    scored = (value, note, poses)
                    rows.append((run.name, variant, column, seed, *scored))

        # One line per score: pandas then takes means over any of the columns.
        names = ["name", "variant", "column", "seed", "value", "note", "poses"]
        frame = pd.DataFrame(rows, columns=names).astype({"poses": float})

        # Some tables print values times 1000.
        shown_larger = frame.column.map(self.columns).isin(self.spec.times_1000)
        frame.loc[shown_larger, ["value", "poses"]] *= 1000

        # Of equal rows, such as the floors of all runs, one with a value is kept.
        frame.loc[frame.variant == FLOOR_VARIANT, ["name", "seed"]] = (
            "",
            NO_SEED,
        )
        frame = frame.sort_values("value", kind="stable", na_position="last")
        frame = frame.drop_duplicates(names[:4]).sort_index()
        if self.metric is None:
            return frame

        # The mean over subjects, seed by seed, if all subjects have scores of the same seeds.
        wide = frame.pivot(
            index=[*names[:2], "seed"], columns="column", values="value"
        )
        means = wide.reindex(columns=self.spec.subjects).mean(
            axis=1, skipna=False
        )
        whole = means.groupby(level=names[:2]).transform(
            lambda values: values.notna().all()
        )
        mean = (
            means.where(whole).rename("value").reset_index().assign(column=MEAN)
        )
        mean["note"] = mean.value.map(
            lambda value: NO_MEAN if pd.isna(value) else None
        )
        return pd.concat([frame, mean])

    def cell(self, name: str, variant: str, column: str) -> Cell:
        """Mean ± sample standard deviation (n - 1) over seeds; one seed has no spread."""
        at = self.scores
        metric = self.columns[column]
        scores = at[
            (at["name"] == name)
            & (at.variant == variant)
            & (at.column == column)
        ]

        # A note names its seeds unless it is about all of them.
        notes = []
        for note, few in scores.groupby("note", sort=False):
            seeds = (
                ""
                if len(few) == len(scores)
                else f"seed {', '.join(few.seed)}: "
            )
            notes.append(f"{seeds}{note}")

        # Without a value, the notes tell why.
        values = scores.value.dropna()
        if values.empty:
            reasons = notes or ["no scored run"]
            return Cell(
                NOT_HAD, notes=tuple(f"{NOT_HAD}: {why}" for why in reasons)
            )

        # The spread is printed with the digits of the mean.
        mean = float(values.mean())
        text = self.write_value(metric, mean)
        spread = None
        if len(values) > 1:
            spread = float(values.std())
            text += f" ± {self.write_value(metric, spread)}"

        # The deviation over poses is a mean over seeds.
        poses = scores.poses.mean()
        if not pd.isna(poses):
            text += f" ({self.write_value(metric, float(poses))})"
        return Cell(text, mean, spread, tuple(notes))

    def check(self, allow_dirty: bool) -> None:
        """Raises ConfigError if the runs of a column or a row are not comparable."""
        where = f"table {self.spec.name}, {self.split}"
        for column in self.columns:
            # Runs of one column have equal data and protocols.
            scored = []
            facts = []
            for run in self.of(None, column):
                if run.images(self.split):
                    scored.append(run)
                    facts.append(
                        _column_facts(run, self, column == MEAN, allow_dirty)
                    )
            check_same(where, scored, facts)
            if column == MEAN:
                continue

            # Runs of one row differ in their seeds only.
            for name in self.names:
                row = self.of(name, column)
                facts = [_row_facts(run, self.split) for run in row]
                if len({run.seed for run in row}) < len(row):
                    names = " and ".join(map(str, row))
                    raise ConfigError(
                        f"{where}: {names} have the same row and seed; leave one out"
                    )
                check_same(where, row, facts)


def _row_facts(run: ScoredRun, split: str) -> dict[str, Any]:
    """Properties that must be equal in one row: all but the seed."""
    return {
        "kind": "predictions" if run.seed is None else "a model trained here",
        "settings": run.settings,
        "iterations": run.facts.get("iterations"),
        "marks": "; ".join(run.of(split, FULL).get("marks", [])) or "none",
    }


def _column_facts(
    run: ScoredRun, part: Part, mean: bool, allow_dirty: bool
) -> dict[str, Any]:
    """Properties that must be equal in one column; data may differ for a mean over subjects."""
    split = part.split
    record = run.protocol(split)
    facts = {
        "protocol": record["name"],
        "LPIPS": run.first_value("lpips_input", split),
        "boxes of hands and mouth": _boxes(run, part),
        UNCOMMITTED: None if allow_dirty else bool(run.facts.get("dirty")),
    }

    # Subjects differ in data, and in a few values of their protocol.
    if mean:
        record = {k: v for k, v in record.items() if k not in PER_SUBJECT}
        return facts | {"values of the protocol": record}
    return facts | {
        DATA: str(run.data.get("fingerprint")),
        "images scored": run.images(split),
        "PSNR of an all-background image": run.of(split, FLOOR_VARIANT).get(
            "psnr"
        ),
        "values of the protocol": record,
    }


@dataclass(frozen=True)
class TableOptions(CommandOptions):
    """The options of tables: conf/report.yaml."""

    table: TableSpec
    runs: str | Sequence[str] | None
    allow_dirty: bool
    out: str | None


def make_tables(options: TableOptions) -> None:
    """Writes a table of runs.

    Raises:
        ConfigError: on runs that do not exist or are not comparable, or on a folder that cannot be
            written.
    """
    # All settings are read before any run is.
    given = [options.runs] if isinstance(options.runs, str) else options.runs
    spec = options.table
    paper = None if spec.paper is None else read_paper(spec.paper)
    runs, left_out = read_runs(find_runs(list(map(str, given or ()))))
    report = build(spec, runs, left_out, paper, allow_dirty=options.allow_dirty)

    # Files are written into a folder named after the time, unless ``out`` names one.
    now = f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
    folder = Path(str(options.out or f"runs/report/{now}")).expanduser()

    # All formats are made before the first file is written.
    files = files_of(report)
    try:
        for name, content in files.items():
            write_atomically(folder / name, content)
    except OSError as error:
        where = error.filename or folder
        raise ConfigError(
            f"{where} cannot be written: {error.strerror}"
        ) from None

    # The terminal shows the same tables without origins.
    console = make_console()
    console.print(Markdown(TERMINAL.body(report)))
    written_files = f"tables: {folder}/{{{','.join(files)}}}"
    console.print(written_files, markup=False, soft_wrap=True)


def build(
    spec: TableSpec,
    runs: Sequence[ScoredRun],
    left_out: Mapping[Path, str],
    paper: PaperTable | None,
    *,
    allow_dirty: bool = False,
) -> Report:
    """A table of ``runs``, with the reasons for those ``left_out`` and the ``paper``'s numbers.

    Raises:
        ConfigError: when runs in one column or row differ in more than they may, or no run is left.
    """
    # Runs that have no place in this table are left out, too.
    left_out = dict(left_out)
    taken = []
    for run in runs:
        why = _no_place(spec, run)
        if why is not None:
            left_out[run.folder] = why
        else:
            taken.append(by_settings(run, spec.by or ()))

    # Each split has a grid, or a grid per metric if subjects are the columns.
    parts = []
    for split in spec.splits:
        if any(run.images(split) for run in taken):
            for metric in [None] if spec.subjects is None else spec.metrics:
                parts.append(Part(spec, taken, split, metric))
    if not parts:
        reasons = "; ".join(
            f"{folder}: {why}" for folder, why in left_out.items()
        )
        raise ConfigError(
            f"table {spec.name}: no run is left that has scored an image of "
            f"{' or '.join(spec.splits)} ({reasons or 'none left out'})"
        )
    for part in parts:
        part.check(allow_dirty)

    # Folders that were left out are named relative to the folder that holds all runs.
    parents = [run.folder.parent for run in taken]
    parents += [folder.parent for folder in left_out]
    shared = os.path.commonpath(parents)
    left = {}
    for folder, why in left_out.items():
        left[os.path.relpath(folder, shared)] = why
    return Report(spec.title, _grids(parts, paper), left)


def _no_place(spec: TableSpec, run: ScoredRun) -> str | None:
    """The reason why the table has no row for a run; raises ConfigError for another data set."""
    if spec.data not in (None, run.data.get("name")):
        what = f"is of {spec.data}, but {run} is of {run.data_name}"
        raise ConfigError(
            f"table {spec.name} {what}; leave it out of runs, or use table=plain"
        )
    if spec.subjects and not run.is_of(spec.subjects):
        return f"its subject is none of {', '.join(spec.subjects)} ({run.data_name})"
    if spec.rows is not None and run.name not in {row.run for row in spec.rows}:
        return f"table {spec.name} has no row for {run.name}"
    return None


def _grids(parts: Sequence[Part], paper: PaperTable | None) -> list[Grid]:
    """The grids of all parts; the paper's rows are added if comparable, else as a last grid."""
    # The paper's rows are added to the grids of splits whose runs are comparable with them.
    grids = []
    reasons = {}
    for part in parts:
        beside = paper
        if paper is not None:
            reasons[part.split] = paper.why_apart(part.runs, part.split)
            if reasons[part.split]:
                beside = None
        grids.append(_grid(part, beside))
    if paper is not None and all(reasons.values()):
        why = reasons.get(str(paper.split)) or next(iter(reasons.values()))
        grids.append(paper.grid(str(why)))
    return grids


def _grid(part: Part, paper: PaperTable | None) -> Grid:
    """The scores, the comparable numbers of the paper, and the floor."""
    columns = part.columns
    # The paper's rows by the name of our model.
    printed = {}
    if paper is not None:
        printed = paper.beside(columns)

    # The paper's rows follow the rows of the same models; the remaining ones are last.
    rows: list[Row] = []
    for spec in part.rows:
        rows.append(_row(part, spec, beside_paper=paper is not None))
        if spec.variant == FULL:
            # The paper's row stands below the same model's.
            rows += printed.pop(spec.run, [])
    for left in printed.values():
        rows += left
    rows = _with_best(rows, part)

    # The floor is last, and never marked as the best.
    floor = [part.cell("", FLOOR_VARIANT, column) for column in columns]
    rows.append(
        Row(FLOOR_LABEL, floor, (NOT_HAD, *_origin(part.runs)), "floor")
    )

    # The metric is in the headings, or in the title if subjects are the columns.
    title = f"{part.split}{SPLIT_TITLES.get(part.split, '')}"
    remarks = [SPREAD_REMARK]
    boxes = join_unique(_boxes(run, part) for run in part.runs)
    if boxes:
        remarks.append(f"Boxes: {boxes}.")
    if part.metric is None:
        return Grid(title, list(map(part.heading, columns)), rows, remarks)
    return Grid(
        f"{part.heading(part.metric)}, {title}", list(columns), rows, remarks
    )


def _row(part: Part, spec: RowSpec, *, beside_paper: bool) -> Row:
    # A row that the table asks for has a place, even if no run was scored.
    runs = part.of(spec.run)
    label = spec.label or spec.run
    if not runs:
        cells = [Cell(NO_RUN)] * len(part.columns)
        origin = ("0", NO_RUN, NO_RUN, NO_RUN)
        return Row(label, cells, origin, notes=("no scored run",))

    # Next to the paper's numbers, a row is named as the paper's method if all its runs are.
    notes = list(dict.fromkeys(_marks(runs, part.split)))
    if beside_paper:
        # Beside the paper's numbers, what differs from the paper's settings is
        # said.
        departures = [run.departures for run in runs]
        if None in departures:
            notes.append("no config says whether it is experiment=paper")
        elif departure := next(filter(None, departures), None):
            notes.append(
                f"differs from experiment=paper: {', '.join(departure)}"
            )
        else:
            whole = (spec.run, spec.variant) == ("full", FULL)
            label = NAME if whole else f"{NAME}, {label}"

    # Columns of subjects may have different numbers of seeds.
    cells = []
    counts = []
    for column in part.columns:
        cells.append(part.cell(spec.run, spec.variant, column))
        if column != MEAN:
            # Columns may have different numbers of seeds.
            counts.append(len(part.of(spec.run, column)))
    seeds = " to ".join(map(str, sorted({min(counts), max(counts)})))
    return Row(label, cells, (seeds, *_origin(runs)), notes=tuple(notes))


def _value(
    run: ScoredRun, split: str, variant: str, metric: str
) -> tuple[float | None, str | None]:
    """A score, and why it is missing or incomplete."""
    # The evaluation writes why it left out a metric.
    held = run.of(split, variant)
    if held.get(metric) is None:
        why = (
            "not scored"
            if held
            else f"no {variant} image of {split} was scored"
        )
        return None, str(held.get(f"{metric}_reason", why))
    note = None
    if left_out := held.get(f"{metric}_left_out"):
        note = f"{left_out} images without a finite score are not in the mean"
    return float(held[metric]), note


def _with_best(rows: Sequence[Row], part: Part) -> list[Row]:
    """Marks the best of our rows in each column that several of them have."""
    cells_by_row = [list(row.cells) for row in rows]
    for i, metric in enumerate(part.columns.values()):
        means = []
        for cells in cells_by_row:
            mean = cells[i].mean
            if mean is not None:
                means.append(mean)

        # A single number is not the best of anything.
        better = METRICS[metric].better
        if len(means) < 2 or not better:
            continue

        # Some metrics are better near 1 than above or below it.
        if better == "↑":
            best = max(means)
        elif better == "↓":
            best = min(means)
        else:
            best = min(means, key=lambda mean: abs(mean - 1))

        # Values that are printed alike are all marked.
        printed = part.write_value(metric, best)
        for cells in cells_by_row:
            mean = cells[i].mean
            if mean is not None and part.write_value(metric, mean) == printed:
                cells[i] = replace(cells[i], best=True)
    return [
        replace(row, cells=cells)
        for row, cells in zip(rows, cells_by_row, strict=True)
    ]


def _origin(runs: Sequence[ScoredRun]) -> tuple[str, ...]:
    """Data, protocol and commit of a row."""
    # Many subjects are counted, not listed.
    data = join_unique(run.data_name for run in runs)
    roots = {run.data.get("root") for run in runs}
    if len(roots) > 1:
        data = f"{runs[0].data['name']}, {len(roots)} subjects"
    protocols = join_unique(run.protocol()["name"] for run in runs)
    return data, protocols, join_unique(run.commit for run in runs)


def _marks(runs: Sequence[ScoredRun], split: str) -> Iterator[str]:
    """Marks (such as a stand-in perceptual loss) and departures that a row must carry."""
    for run in runs:
        for held in run.scores.get(split, {}).values():
            for mark in held.get("marks", []):
                yield f"marked: {mark}"
        record = run.protocol(split)
        for departure in record.get("departures", []):
            yield f"departs from {record['name']}: {departure}"


def _boxes(run: ScoredRun, part: Part) -> str | None:
    """The boxes of hands and mouth of a run, if the grid has a metric in them."""
    # Without such a metric, runs of different boxes are comparable.
    if set(BOX_METRICS).isdisjoint(part.columns.values()):
        return None
    return run.first_value("boxes", part.split)
