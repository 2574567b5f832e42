"""Tables of ``runs``: rows and columns, statistics over seeds, and what belongs below them."""

from __future__ import annotations

import os
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig
from rich.markdown import Markdown

from gsgan.evaluate.paper import NAME, clause
from gsgan.report.paper import PaperTable, read_paper
from gsgan.report.runs import DATA, Run, by_settings, check_same, find_runs, read_runs
from gsgan.report.spec import (
    FLOOR,
    IN_BOXES,
    MEAN,
    METRICS,
    PAINTED,
    SPLAT,
    RowSpec,
    TableSpec,
    heading,
    natural,
    subject_of,
    written,
)
from gsgan.report.write import (
    MARKDOWN,
    NO_RUN,
    NOT_HAD,
    TERMINAL,
    Cell,
    Grid,
    Report,
    Row,
    common,
    pages,
)
from gsgan.utils.console import make_console
from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically
from gsgan.utils.pages import check_block, fill_block

CURVES = "report.png"
BLOCK_END = "<!-- /report -->"
FLOOR_LABEL = "all background (floor)"
SPREAD = (
    "Mean ± sample standard deviation over seeds, as many as the column seeds says; one seed has "
    "no spread."
)
SPLIT_TITLES = {"novel_view": " (held-out cameras)", "novel_pose": " (held-out poses)"}
FACTS = ("version", "iterations", "train_seconds", "device", "torch", "date")
PER_SUBJECT = ("subject", "train_frames", "test_frames")  # of a protocol, differ by subject
DIRTY = "uncommitted changes of the code (allow_dirty=true allows them)"
NO_SEED = "None"  # of predictions and of the all-background image
Values = dict[str, tuple[float | None, str | None]]  # by seed: value, why missing or incomplete


@dataclass(frozen=True)
class Part:
    """One grid: the scores of one split, of one ``metric`` where subjects are the columns."""

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

    def heading(self, metric: str) -> str:
        """Of a metric; LPIPS with its backbone and region, where runs have it."""
        named = common(_lpips(run, self.split) or "" for run in self.runs)
        return f"{named} ↓" if metric == "lpips" and named else heading(metric)

    def of(self, name: str | None, column: str = MEAN) -> list[Run]:
        """The runs of a model or method (None: of all) that a column shows."""
        shown = self.runs if name is None else [run for run in self.runs if run.name == name]
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
            RowSpec(name, f"{name}: Step I's colour" if variant == SPLAT else None, variant)
            for name in sorted(names, key=lambda name: (name != "full", natural(name)))
            for variant in self.spec.variants
            if any(run.of(self.split, variant) for run in self.of(name))
        ]

    def values(self, name: str | None, variant: str, column: str) -> Values:
        """One cell's scores by seed; the all-background image (name None) has one for all runs."""
        if column == MEAN:
            return self._over_subjects(name, variant)
        metric, runs = self.columns[column], self.of(name, column)
        found = {str(run.seed): _value(run, self.split, variant, metric) for run in runs}
        if name is None and found:  # one for all: they are of the same data
            scored = [pair for pair in found.values() if pair[0] is not None]
            return {NO_SEED: (scored or list(found.values()))[0]}
        return found

    def _over_subjects(self, name: str | None, variant: str) -> Values:
        """The mean over subjects, seed by seed."""
        held = [self.values(name, variant, subject) for subject in self.spec.subjects or ()]
        scores = [
            {seed: value for seed, (value, _) in found.items() if value is not None}
            for found in held
        ]
        seeds = scores[0].keys()
        if not seeds or any(found.keys() != seeds for found in scores):
            return {NO_SEED: (None, "no mean over subjects: not all have scores of these seeds")}
        return {s: (statistics.fmean(found[s] for found in scores), None) for s in seeds}

    def check(self, allow_dirty: bool) -> None:
        """Raises ConfigError where a column or a row would mix what does not belong together."""
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
                    raise ConfigError(f"{where}: {names} have the same row and seed; leave one out")
                check_same(where, row, [_row_facts(run, self.split) for run in row])


def _row_facts(run: Run, split: str) -> dict[str, Any]:
    """What the runs of one row have in common: all but the seed."""
    return {
        "kind": "predictions" if run.seed is None else "a model trained here",
        "settings": run.settings,
        "iterations": run.facts.get("iterations"),
        "marks": "; ".join(run.of(split, PAINTED).get("marks", [])) or "none",
    }


def _column_facts(run: Run, part: Part, mean: bool, allow_dirty: bool) -> dict[str, Any]:
    """What the runs of one column have in common; those of a mean over subjects differ in data."""
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
        ConfigError: on runs that do not exist or do not belong into one table, or on a page or
            folder that cannot be written.
    """
    given = [config.runs] if isinstance(config.runs, str) else config.runs
    spec: TableSpec = instantiate(config.table)
    paper = None if spec.paper is None else read_paper(spec.paper)
    page = None if config.fill is None else Path(str(config.fill)).expanduser()
    start = f"<!-- report:{spec.name} -->"
    if page is not None:
        check_block(page, start, BLOCK_END, key="fill")
    runs, left_out = read_runs(find_runs([str(entry) for entry in given]))
    report = build(spec, runs, left_out, paper, allow_dirty=config.allow_dirty)
    now = f"{datetime.now():%Y-%m-%d_%H-%M-%S}"
    folder = Path(str(config.out or f"runs/report/{now}")).expanduser()
    files: dict[str, str | bytes] = dict(pages(report))
    if spec.by:
        from gsgan.report.curves import curves  # here: it imports matplotlib

        files |= {CURVES: image} if (image := curves(report)) else {}
    try:
        for name, content in files.items():
            write_atomically(folder / name, content)
        if page is not None:
            fill_block(page, start, BLOCK_END, MARKDOWN.body(report), key="fill")
    except OSError as error:
        where = error.filename or folder
        raise ConfigError(f"{where} cannot be written: {error.strerror}") from None
    console = make_console()
    console.print(Markdown(TERMINAL.body(report)))
    filled = "" if page is None else f"\nfilled: {page}"
    done = f"tables: {folder}/{{{','.join(files)}}}{filled}"
    console.print(done, markup=False, soft_wrap=True)


def build(
    spec: TableSpec,
    runs: Sequence[Run],
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
    records = [
        {"folder": names[run.folder], "name": run.name, "seed": run.seed, "data": run.data}
        | {"protocol": run.protocol()["name"], "commit": run.commit}
        | {key: run.facts.get(key) for key in FACTS}
        for run in taken
    ]
    left = {names[folder]: reason for folder, reason in left_out.items()}
    return Report(spec.name, spec.title, _grids(parts, paper), records, left)


def _no_place(spec: TableSpec, run: Run) -> str | None:
    """Why the table has no place for a run; raises ConfigError on another data set's."""
    if spec.data not in (None, run.data.get("name")):
        what = f"is of {spec.data}, but {run} is of {run.data_name}"
        raise ConfigError(f"table {spec.name} {what}; leave it out of runs, or use table=plain")
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
    rows = _with_best([*rows, *(row for left in printed.values() for row in left)], part)
    floor = [mean_cell(m, part.values(None, FLOOR, c)) for c, m in columns.items()]
    rows.append(Row(FLOOR_LABEL, floor, (NOT_HAD, *_origin(part.runs)), "floor"))
    title = f"{part.split}{SPLIT_TITLES.get(part.split, '')}"
    boxes = common(_boxes(run, part) or "" for run in part.runs)
    remarks = [SPREAD, f"Boxes: {boxes}."] if boxes else [SPREAD]
    if part.metric is None:
        return Grid(title, [part.heading(m) for m in columns], rows, remarks)
    return Grid(f"{part.heading(part.metric)}, {title}", list(columns), rows, remarks)


def _row(part: Part, spec: RowSpec, *, beside_paper: bool) -> Row:
    runs, label, shown = part.of(spec.run), spec.label or spec.run, (spec.run, spec.variant)
    if not runs:
        cells = [Cell(NO_RUN, {"n": 0}) for _ in part.columns]
        return Row(label, cells, ("0", NO_RUN, NO_RUN, NO_RUN), notes=("no scored run",))
    notes = list(dict.fromkeys(_marks(runs, part.split)))
    if beside_paper:  # named as the paper's method where all runs are
        departures = [run.departures() for run in runs]
        if None in departures:
            notes.append("no config says whether it is experiment=paper")
        elif found := next(filter(None, departures), None):
            notes.append(clause(found))
        else:
            label = NAME if shown == ("full", PAINTED) else f"{NAME}, {label}"
    counts = [len(part.of(spec.run, column)) for column in part.columns if column != MEAN]
    seeds = " to ".join(map(str, dict.fromkeys((min(counts), max(counts)))))
    cells = [mean_cell(m, part.values(*shown, c)) for c, m in part.columns.items()]
    return Row(label, cells, (seeds, *_origin(runs)), notes=tuple(notes))


def mean_cell(metric: str, found: Values) -> Cell:
    """Mean ± sample standard deviation (n − 1) over seeds; one seed has no spread."""
    by_note: dict[str, list[str]] = {}
    for seed, (_, note) in found.items():
        if note is not None:
            by_note.setdefault(note, []).append(seed)
    notes = [
        note if len(seeds) == len(found) else f"seed {', '.join(seeds)}: {note}"
        for note, seeds in by_note.items()
    ]
    values = {seed: value for seed, (value, _) in found.items() if value is not None}
    if not values:
        notes = [f"{NOT_HAD}: {note}" for note in notes or ["no scored run"]]
        return Cell(NOT_HAD, {"n": 0}, tuple(notes))
    mean = statistics.fmean(values.values())
    spread = statistics.stdev(values.values()) if len(values) > 1 else None
    text = written(metric, mean) + ("" if spread is None else f" ± {written(metric, spread)}")
    numbers = {"mean": mean, "spread": spread, "n": len(values), "seeds": values}
    return Cell(text, numbers, tuple(notes))


def _value(run: Run, split: str, variant: str, metric: str) -> tuple[float | None, str | None]:
    """A score, and why it is missing or incomplete."""
    held = run.of(split, variant)
    if held.get(metric) is None:
        why = "not scored" if held else f"no {variant} image of {split} was scored"
        return None, str(held.get(f"{metric}_reason", why))
    left_out = held.get(f"{metric}_left_out")
    note = f"{left_out} images without a finite score are not in the mean" if left_out else None
    return float(held[metric]), note


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


def _origin(runs: Sequence[Run]) -> tuple[str, ...]:
    """Data, protocol and commit of a row."""
    data = common(run.data_name for run in runs)
    if len(roots := {run.data.get("root") for run in runs}) > 1:
        data = f"{runs[0].data['name']}, {len(roots)} subjects"
    return data, common(r.protocol()["name"] for r in runs), common(r.commit for r in runs)


def _marks(runs: Sequence[Run], split: str) -> Iterator[str]:
    """Marks (such as a stand-in perceptual loss) and departures that a row must carry."""
    for run in runs:
        for held in run.scores.get(split, {}).values():
            yield from (f"marked: {mark}" for mark in held.get("marks", []))
        record = run.protocol(split)
        yield from (f"departs from {record['name']}: {d}" for d in record.get("departures", []))


def _lpips(run: Run, split: str) -> str | None:
    """Backbone and range of a run's LPIPS, where it has one."""
    scores = run.scores.get(split, {}).values()
    return next((s.get("lpips_name") for s in scores if s.get("lpips") is not None), None)


def _boxes(run: Run, part: Part) -> str | None:
    """What a run's boxes of hands and mouth contain, if the grid has a metric in them."""
    shown = {*IN_BOXES} & {*part.columns.values()}
    scores = run.scores.get(part.split, {}).values() if shown else ()
    return next((s["boxes"] for s in scores if s.get("boxes")), None)
