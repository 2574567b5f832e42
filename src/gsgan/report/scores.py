"""One tidy frame of scores, and statistics over its seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from gsgan.report.runs import Run
from gsgan.report.spec import FLOOR, MEAN, PAINTED, SPLAT, subject_of, written
from gsgan.report.write import NOT_HAD, Cell

NO_SEED = "None"  # of predictions and of the all-background image
KEYS = ["name", "variant", "column"]
Values = dict[tuple[str, str, str], pd.DataFrame]  # by row name, variant and column


def scores(runs: Sequence[Run], split: str, columns: Mapping[str, str]) -> Values:
    """Scores by row name, variant and column.

    Args:
        runs: all of a grid's.
        split: whose scores.
        columns: the metric of each column. Columns are metrics, or subjects and ``mean``.

    Returns:
        For each cell a row per seed: ``seed`` (a text), ``value`` (NaN where there is none) and
        ``note`` (why, or None). The all-background image has the name ``floor`` and one row.
    """
    subjects = [column for column, metric in columns.items() if column not in (metric, MEAN)]
    rows = [
        (
            *((FLOOR, FLOOR) if variant == FLOOR else (run.name, variant)),
            subject_of(run.data.get("root"), subjects) if subjects else metric,
            NO_SEED if variant == FLOOR else str(run.seed),
            *_value(run, split, variant, metric),
        )
        for run in runs
        for variant in (PAINTED, SPLAT, FLOOR)
        for metric in dict.fromkeys(columns.values())
    ]
    frame = pd.DataFrame(rows, columns=[*KEYS, "seed", "value", "note"])
    own = frame.name != FLOOR  # one floor for all runs: they are of the same data
    floor = frame[~own].sort_values("value").drop_duplicates("column")
    frame = pd.concat([frame[own], floor])
    if subjects:
        means = [
            _over_subjects(found, subjects).assign(name=name, variant=variant, column=MEAN)
            for (name, variant), found in frame.groupby(KEYS[:2], sort=False)
        ]
        frame = pd.concat([frame, *means])
    return dict(list(frame.groupby(KEYS, sort=False)))


def _value(run: Run, split: str, variant: str, metric: str) -> tuple[float, str | None]:
    """A score, and why it is missing or incomplete."""
    held = run.of(split, variant)
    if held.get(metric) is None:
        why = "not scored" if held else f"no {variant} image of {split} was scored"
        return float("nan"), str(held.get(f"{metric}_reason", why))
    left_out = held.get(f"{metric}_left_out")
    note = f"{left_out} images without a finite score are not in the mean" if left_out else None
    return float(held[metric]), note


def _over_subjects(found: pd.DataFrame, subjects: Sequence[str]) -> pd.DataFrame:
    """The mean over subjects, seed by seed where all subjects have the same seeds."""
    values = found.pivot_table(index="seed", columns="column", values="value", sort=False)
    if values.notna().all(axis=None) and set(subjects) == set(values):
        return values.mean(axis=1).rename("value").reset_index().assign(note=None)
    if missing := [subject for subject in subjects if subject not in values]:
        mean, note = float("nan"), f"no mean over subjects: {', '.join(missing)} missing"
    else:
        mean = values.mean().mean()
        note = "mean of the subjects' means, without spread: their seeds differ"
    return pd.DataFrame({"seed": [NO_SEED], "value": [mean], "note": [note]})


def mean_cell(metric: str, found: pd.DataFrame | None) -> Cell:
    """Mean ± sample standard deviation (n − 1) over seeds; one seed has no spread."""
    if found is None:
        return Cell(NOT_HAD, {"n": 0}, (f"{NOT_HAD}: no scored run",))
    notes = tuple(
        str(note) if len(seeds) == len(found) else f"seed {', '.join(seeds)}: {note}"
        for note, seeds in found.groupby("note", sort=False)["seed"]
    )
    values = found.set_index("seed")["value"].dropna()
    if values.empty:
        return Cell(NOT_HAD, {"n": 0}, tuple(f"{NOT_HAD}: {note}" for note in notes))
    return replace(_statistics(metric, values), notes=notes)


def difference(metric: str, mine: pd.DataFrame | None, reference: pd.DataFrame | None) -> Cell:
    """A row less the reference, seed by seed, and how many seeds have the mean's sign."""
    if mine is None or reference is None:
        return Cell(NOT_HAD, {"n": 0})
    ours, theirs = (f[f.seed != NO_SEED].set_index("seed")["value"] for f in (mine, reference))
    values = (ours - theirs).dropna()
    if values.empty:
        return Cell(NOT_HAD, {"n": 0}, (f"{NOT_HAD}: no seed in which both have it",))
    cell = _statistics(metric, values, signed=True)
    agreeing = int((np.sign(values) == np.sign(values.mean())).sum())
    text = f"{cell.text} ({agreeing}/{len(values)})"
    return replace(cell, text=text, numbers={**cell.numbers, "agreeing": agreeing})


def _statistics(metric: str, values: pd.Series, *, signed: bool = False) -> Cell:
    mean, spread = float(values.mean()), float(values.std()) if len(values) > 1 else None
    text = written(metric, mean, signed=signed)
    text += "" if spread is None else f" ± {written(metric, spread)}"
    numbers = {"mean": mean, "spread": spread, "n": len(values), "seeds": values.to_dict()}
    return Cell(text, numbers)
