"""Tables of ``runs``: rows and columns, statistics over seeds, and notes."""

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd
from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.markdown import Markdown

from gsgan.metrics.names import BOX_METRICS, METRICS
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
    FLOOR,
    MEAN,
    PAINTED,
    SPLAT,
    RowSpec,
    TableSpec,
    natural,
    subject_of,
    written,
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
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically

FLOOR_LABEL = "all background (floor)"
SPREAD = (
    "Mean ± sample standard deviation over seeds, as many as the column seeds says; one seed has "
    "no spread."
)
SPLIT_TITLES = {"novel_view": " (held-out cameras)", "novel_pose": " (held-out poses)"}
# of a protocol, differ by subject
PER_SUBJECT = ("subject", "train_frames", "test_frames")
DIRTY = "uncommitted changes of the code (allow_dirty=true allows them)"
NO_SEED = "None"  # of predictions and of the all-background image
NO_MEAN = "no mean over subjects: not all have scores of these seeds"


@dataclass(frozen=True)
class Part:
    """One grid: the scores of one split, of one ``metric`` where subjects are the columns."""

    spec: TableSpec
    runs: Sequence[ScoredRun]
    split: str
    metric: str | None = None

    @property
    def columns(self) -> dict[str, str]:
        """The metric of each column: metrics themselves, or subjects and their mean."""
        if self.metric is None:
            return {metric: metric for metric in self.spec.metrics}
        return dict.fromkeys([*(self.spec.subjects or ()), MEAN], self.metric)

    def heading(self, metric: str) -> str:
        """Of a metric; LPIPS with what its network gets, if runs have it."""
        name = METRICS[metric].name
        described = join_unique(_lpips(run, self.split) or "" for run in self.runs)
        if metric.startswith("lpips") and described:
            name = f"{name} {described}"
        if metric in self.spec.times_1000:
            name = f"{name} ×1000"
        return f"{name} {METRICS[metric].better}"

    def written(self, metric: str, value: float) -> str:
        """A value of this table, with the metric's digits."""
        return written(metric, value, times_1000=metric in self.spec.times_1000)

    def of(self, name: str | None, column: str = MEAN) -> list[ScoredRun]:
        """The runs of a model or method (None: of all) that a column shows."""
        shown = (
            self.runs
            if name is None
            else [run for run in self.runs if run.name == name]
        )
        if self.metric is None or column == MEAN:
            return list(shown)
        return [run for run in shown if subject_of(run.data.get("root"), [column])]

    @property
    def rows(self) -> list[RowSpec]:
        """The table's rows; where it does not fix them, those that have a score."""
        if self.spec.rows is not None:
            return list(self.spec.rows)
        names = {run.name for run in self.runs}
        return [
            RowSpec(
                name, f"{name}: Step I's colour" if variant == SPLAT else None, variant
            )
            for name in sorted(names, key=lambda name: (name != "full", natural(name)))
            for variant in self.spec.variants
            if any(run.of(self.split, variant) for run in self.of(name))
        ]

    @cached_property
    def scores(self) -> pd.DataFrame:
        """One row per run, variant and column: ``name variant column seed value note``.

        The all-background image is of the data, not of a model or seed, so it has one row per
        column, without a name.
        """
        rows = [
            (
                run.name,
                variant,
                column,
                str(run.seed),
                *_value(run, self.split, variant, metric),
            )
            for column, metric in self.columns.items()
            if column != MEAN
            for run in self.of(None, column)
            for variant in (PAINTED, SPLAT, FLOOR)
        ]
        names = ["name", "variant", "column", "seed", "value", "note"]
        frame = pd.DataFrame(rows, columns=names)
        shown_larger = frame.column.map(self.columns).isin(self.spec.times_1000)
        frame.loc[shown_larger, "value"] *= 1000
        frame.loc[frame.variant == FLOOR, ["name", "seed"]] = "", NO_SEED
        frame = frame.sort_values("value", kind="stable", na_position="last")
        frame = frame.drop_duplicates(names[:4]).sort_index()
        if self.metric is None:
            return frame
        # The mean over subjects, seed by seed, where all subjects have scores of the same seeds.
        wide = frame.pivot(index=[*names[:2], "seed"], columns="column", values="value")
        means = wide.reindex(columns=self.spec.subjects).mean(axis=1, skipna=False)
        whole = means.groupby(level=names[:2]).transform(lambda own: own.notna().all())
        mean = means.where(whole).rename("value").reset_index().assign(column=MEAN)
        mean["note"] = mean.value.map(lambda value: NO_MEAN if pd.isna(value) else None)
        return pd.concat([frame, mean])

    def cell(self, name: str, variant: str, column: str) -> Cell:
        """Mean ± sample standard deviation (n - 1) over seeds; one seed has no spread."""
        at = self.scores
        metric = self.columns[column]
        own = at[(at["name"] == name) & (at.variant == variant) & (at.column == column)]
        notes = [
            note if len(few) == len(own) else f"seed {', '.join(few.seed)}: {note}"
            for note, few in own.groupby("note", sort=False)
        ]
        values = own.value.dropna()
        if values.empty:
            notes = [f"{NOT_HAD}: {note}" for note in notes or ["no scored run"]]
            return Cell(NOT_HAD, notes=tuple(notes))
        mean = float(values.mean())
        spread = float(values.std()) if len(values) > 1 else None
        text = self.written(metric, mean)
        if spread is not None:
            text += f" ± {self.written(metric, spread)}"
        return Cell(text, mean, spread, tuple(notes))

    def check(self, allow_dirty: bool) -> None:
        """Raises ConfigError where the runs of a column or a row are not comparable."""
        where = f"table {self.spec.name}, {self.split}"
        for column in self.columns:
            scored = [run for run in self.of(None, column) if run.images(self.split)]
            mean = column == MEAN
            facts = [_column_facts(run, self, mean, allow_dirty) for run in scored]
            check_same(where, scored, facts)
            for name in {run.name for run in self.runs} if column != MEAN else ():
                row = self.of(name, column)
                if len({run.seed for run in row}) < len(row):
                    names = " and ".join(map(str, row))
                    raise ConfigError(
                        f"{where}: {names} have the same row and seed; leave one out"
                    )
                check_same(where, row, [_row_facts(run, self.split) for run in row])


def _row_facts(run: ScoredRun, split: str) -> dict[str, Any]:
    """Properties that must be equal in one row: all but the seed."""
    return {
        "kind": "predictions" if run.seed is None else "a model trained here",
        "settings": run.settings,
        "iterations": run.facts.get("iterations"),
        "marks": "; ".join(run.of(split, PAINTED).get("marks", [])) or "none",
    }


def _column_facts(
    run: ScoredRun, part: Part, mean: bool, allow_dirty: bool
) -> dict[str, Any]:
    """Properties that must be equal in one column; data may differ for a mean over subjects."""
    split = part.split
    record = run.protocol(split)
    facts = {
        "protocol": record["name"],
        "LPIPS": _lpips(run, split),
        "boxes of hands and mouth": _boxes(run, part),
        DIRTY: None if allow_dirty else bool(run.facts.get("dirty")),
    }
    if mean:
        record = {k: v for k, v in record.items() if k not in PER_SUBJECT}
        return facts | {"values of the protocol": record}
    return facts | {
        DATA: str(run.data.get("fingerprint")),
        "images scored": run.images(split),
        "PSNR of an all-background image": run.of(split, FLOOR).get("psnr"),
        "values of the protocol": record,
    }


def make_tables(config: DictConfig) -> None:
    """Writes the table ``config.table`` of ``config.runs`` into ``config.out``.

    Raises:
        ConfigError: on runs that do not exist or are not comparable, or on a folder that cannot be
            written.
    """
    given = [config.runs] if isinstance(config.runs, str) else config.runs
    spec: TableSpec = instantiate(config.table)
    paper = None if spec.paper is None else read_paper(spec.paper)
    runs, left_out = read_runs(find_runs([str(entry) for entry in given]))
    report = build(spec, runs, left_out, paper, allow_dirty=config.allow_dirty)
    now = f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
    folder = Path(str(config.out or f"runs/report/{now}")).expanduser()
    files = files_of(report)
    try:
        for name, content in files.items():
            write_atomically(folder / name, content)
    except OSError as error:
        where = error.filename or folder
        raise ConfigError(f"{where} cannot be written: {error.strerror}") from None
    console = make_console()
    console.print(Markdown(TERMINAL.body(report)))
    console.print(
        f"tables: {folder}/{{{','.join(files)}}}", markup=False, soft_wrap=True
    )


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
    unfit = {run.folder: why for run in runs if (why := _no_place(spec, run))}
    taken = [by_settings(run, spec.by or ()) for run in runs if run.folder not in unfit]
    left_out = {**left_out, **unfit}
    parts = [
        Part(spec, taken, split, metric)
        for split in spec.splits
        for metric in ([None] if spec.subjects is None else spec.metrics)
        if any(run.images(split) for run in taken)
    ]
    if not parts:
        reasons = "; ".join(
            f"{folder}: {reason}" for folder, reason in left_out.items()
        )
        raise ConfigError(
            f"table {spec.name}: no run is left that has scored an image of "
            f"{' or '.join(spec.splits)} ({reasons or 'none left out'})"
        )
    for part in parts:
        part.check(allow_dirty)
    folders = [*(run.folder for run in taken), *left_out]
    shared = os.path.commonpath([folder.parent for folder in folders])
    names = {folder: os.path.relpath(folder, shared) for folder in folders}
    left = {names[folder]: reason for folder, reason in left_out.items()}
    return Report(spec.title, _grids(parts, paper), left)


def _no_place(spec: TableSpec, run: ScoredRun) -> str | None:
    """Why the table has no row for a run; raises ConfigError for another data set."""
    if spec.data not in (None, run.data.get("name")):
        what = f"is of {spec.data}, but {run} is of {run.data_name}"
        raise ConfigError(
            f"table {spec.name} {what}; leave it out of runs, or use table=plain"
        )
    if spec.subjects and subject_of(run.data.get("root"), spec.subjects) is None:
        return f"its subject is none of {', '.join(spec.subjects)} ({run.data_name})"
    if spec.rows is not None and run.name not in {row.run for row in spec.rows}:
        return f"table {spec.name} has no row for {run.name}"
    return None


def _grids(parts: Sequence[Part], paper: PaperTable | None) -> list[Grid]:
    """The grids of all parts; the paper's rows are added where comparable, else as a last grid."""
    if paper is None:
        return [_grid(part, None) for part in parts]
    reasons = {part.split: paper.why_apart(part.runs, part.split) for part in parts}
    found = [_grid(part, None if reasons[part.split] else paper) for part in parts]
    if all(reasons.values()):
        why = reasons.get(str(paper.split)) or next(iter(reasons.values()))
        found.append(paper.grid(str(why)))
    return found


def _grid(part: Part, paper: PaperTable | None) -> Grid:
    """The scores, the comparable numbers of the paper, and the floor."""
    columns = part.columns
    printed = {}
    if paper is not None:
        printed = paper.beside([(None if c == m else c, m) for c, m in columns.items()])
    rows: list[Row] = []
    for spec in part.rows:
        rows.append(_row(part, spec, beside_paper=paper is not None))
        if spec.variant == PAINTED:
            rows += printed.pop(spec.run, [])
    rows = _with_best(
        [*rows, *(row for left in printed.values() for row in left)], part
    )
    floor = [part.cell("", FLOOR, c) for c in columns]
    rows.append(Row(FLOOR_LABEL, floor, (NOT_HAD, *_origin(part.runs)), "floor"))
    title = f"{part.split}{SPLIT_TITLES.get(part.split, '')}"
    boxes = join_unique(_boxes(run, part) or "" for run in part.runs)
    remarks = [SPREAD, f"Boxes: {boxes}."] if boxes else [SPREAD]
    if part.metric is None:
        return Grid(title, [part.heading(m) for m in columns], rows, remarks)
    return Grid(f"{part.heading(part.metric)}, {title}", list(columns), rows, remarks)


def _row(part: Part, spec: RowSpec, *, beside_paper: bool) -> Row:
    runs = part.of(spec.run)
    label = spec.label or spec.run
    shown = (spec.run, spec.variant)
    if not runs:
        cells = [Cell(NO_RUN) for _ in part.columns]
        return Row(
            label, cells, ("0", NO_RUN, NO_RUN, NO_RUN), notes=("no scored run",)
        )
    notes = list(dict.fromkeys(_marks(runs, part.split)))
    if beside_paper:  # named as the paper's method where all runs are
        if any(run.departures is None for run in runs):
            notes.append("no config says whether it is experiment=paper")
        elif found := next(filter(None, (run.departures for run in runs)), None):
            notes.append(f"differs from experiment=paper: {', '.join(found)}")
        else:
            label = NAME if shown == ("full", PAINTED) else f"{NAME}, {label}"
    counts = [
        len(part.of(spec.run, column)) for column in part.columns if column != MEAN
    ]
    seeds = " to ".join(map(str, dict.fromkeys((min(counts), max(counts)))))
    cells = [part.cell(*shown, c) for c in part.columns]
    return Row(label, cells, (seeds, *_origin(runs)), notes=tuple(notes))


def _value(
    run: ScoredRun, split: str, variant: str, metric: str
) -> tuple[float | None, str | None]:
    """A score, and why it is missing or incomplete."""
    held = run.of(split, variant)
    if held.get(metric) is None:
        why = "not scored" if held else f"no {variant} image of {split} was scored"
        return None, str(held.get(f"{metric}_reason", why))
    left_out = held.get(f"{metric}_left_out")
    note = (
        f"{left_out} images without a finite score are not in the mean"
        if left_out
        else None
    )
    return float(held[metric]), note


def _with_best(rows: Sequence[Row], part: Part) -> list[Row]:
    """Marks the best of our rows in each column that several of them have."""
    found = [list(row.cells) for row in rows]
    for i, metric in enumerate(part.columns.values()):
        sign = {"↑": -1, "↓": 1}.get(METRICS[metric].better)
        means = [mean for cells in found if (mean := cells[i].mean) is not None]
        if len(means) < 2:
            continue
        best = min(
            means, key=lambda mean: abs(mean - 1) if sign is None else sign * mean
        )
        for cells in found:
            mean = cells[i].mean
            equal = mean is not None and part.written(metric, mean) == part.written(
                metric, best
            )
            cells[i] = replace(cells[i], best=equal)
    return [replace(row, cells=cells) for row, cells in zip(rows, found, strict=True)]


def _origin(runs: Sequence[ScoredRun]) -> tuple[str, ...]:
    """Data, protocol and commit of a row."""
    data = join_unique(run.data_name for run in runs)
    if len(roots := {run.data.get("root") for run in runs}) > 1:
        data = f"{runs[0].data['name']}, {len(roots)} subjects"
    protocols = [run.protocol()["name"] for run in runs]
    commits = [run.commit for run in runs]
    return data, join_unique(protocols), join_unique(commits)


def _marks(runs: Sequence[ScoredRun], split: str) -> Iterator[str]:
    """Marks (such as a stand-in perceptual loss) and departures that a row must carry."""
    for run in runs:
        for held in run.scores.get(split, {}).values():
            yield from (f"marked: {mark}" for mark in held.get("marks", []))
        record = run.protocol(split)
        yield from (
            f"departs from {record['name']}: {d}" for d in record.get("departures", [])
        )


def _lpips(run: ScoredRun, split: str) -> str | None:
    """What the networks of a run's LPIPS get, if it has one."""
    scores = run.scores.get(split, {}).values()
    return next((s["lpips_input"] for s in scores if s.get("lpips_input")), None)


def _boxes(run: ScoredRun, part: Part) -> str | None:
    """The boxes of hands and mouth of a run, if the grid has a metric in them."""
    shown = {*BOX_METRICS} & {*part.columns.values()}
    scores = run.scores.get(part.split, {}).values() if shown else ()
    return next((s["boxes"] for s in scores if s.get("boxes")), None)
