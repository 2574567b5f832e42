"""From runs to cells: mean and spread over seeds, differences seed by seed, reasons for gaps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, stdev
from typing import Any

from gsgan.report.grid import NOT_HAD, Cell
from gsgan.report.paper import MEAN
from gsgan.report.scored import Run
from gsgan.report.spec import PAINTED, shown, subject_of

BySeed = dict[int | None, float]  # predictions have no seed


@dataclass(frozen=True)
class Column:
    """What one column shows.

    Args:
        heading: of it.
        metric: a key of `METRICS`.
        subject: whose runs; None for any, `MEAN` for the mean over ``subjects``.
        subjects: all of the table's.
    """

    heading: str
    metric: str
    subject: str | None = None
    subjects: tuple[str, ...] = ()

    def of(self, runs: Sequence[Run]) -> list[Run]:
        """Those of the runs that this column shows."""
        if self.subject is None or self.subject == MEAN:
            return list(runs)
        return [r for r in runs if subject_of(r.data.get("root"), [self.subject]) is not None]

    def parts(self) -> Iterator[Column]:
        """The columns that a mean is over."""
        for subject in self.subjects:
            yield Column(subject, self.metric, subject)


@dataclass(frozen=True)
class Source:
    """Where a row's values come from.

    Args:
        runs: of the row.
        split: which is shown.
        variant: of the pictures.
    """

    runs: Sequence[Run]
    split: str
    variant: str = PAINTED

    def values(self, column: Column) -> tuple[BySeed, list[str]]:
        """One column's values by seed, and a sentence for each that is not there."""
        if column.subject == MEAN:
            return self._means(column)
        found: BySeed = {}
        missing: dict[str, list[str]] = {}
        runs = column.of(self.runs)
        for run in runs:
            value, reason = _value(run, self.split, self.variant, column.metric)
            if value is not None:
                found[run.seed] = value
            if reason:
                missing.setdefault(reason, []).append(str(run.seed))
        notes = [
            reason if len(seeds) == len(runs) else f"seed {', '.join(seeds)}: {reason}"
            for reason, seeds in missing.items()
        ]
        return found, notes if runs else ["no scored run"]

    def _means(self, column: Column) -> tuple[BySeed, list[str]]:
        parts = {c.heading: self.values(c)[0] for c in column.parts()}
        if lacking := [subject for subject, values in parts.items() if not values]:
            return {}, [f"no mean over subjects: {', '.join(lacking)} missing"]
        seeds = set.intersection(*(set(values) for values in parts.values()))
        if seeds and all(set(values) == seeds for values in parts.values()):
            return {s: fmean(v[s] for v in parts.values()) for s in sorted(seeds, key=str)}, []
        mean = fmean(fmean(values.values()) for values in parts.values())
        return {None: mean}, ["mean of the subjects' means, without spread: their seeds differ"]

    def cell(self, column: Column) -> Cell:
        """Mean ± spread of one column."""
        values, notes = self.values(column)
        summary = summarise(list(values.values()))
        if summary is None:
            return Cell(NOT_HAD, {"n": 0}, tuple(f"{NOT_HAD}: {note}" for note in notes))
        numbers = _numbers(summary, values)
        return Cell(_text(column.metric, summary), numbers, tuple(notes))

    def difference(self, column: Column, reference: Source) -> Cell:
        """What the row has over the reference, over the seeds that both have."""
        mine, theirs = (
            {seed: v for seed, v in source.values(column)[0].items() if seed is not None}
            for source in (self, reference)
        )
        found = paired(mine, theirs)
        if found is None:
            return Cell(NOT_HAD, {"n": 0}, ("n/a: no seed in which both have it",))
        text = _text(column.metric, found.summary, signed=True)
        numbers = {**_numbers(found.summary, found.by_seed), "agreeing": found.agreeing}
        return Cell(f"{text} ({found.agreeing}/{found.summary.n})", numbers)


def _value(run: Run, split: str, variant: str, metric: str) -> tuple[float | None, str]:
    """A score, and why it is not there or not whole."""
    if split not in run.scores:
        return None, f"{split} was not scored"
    scores = run.of(split, variant)
    if scores is None:
        return None, "the method has no such picture"
    if metric not in scores:
        return None, f"{metric} is not in metrics.json: score the run again"
    if scores[metric] is None:
        return None, str(scores.get(f"{metric}_reason", "not scored"))
    if left_out := scores.get(f"{metric}_left_out"):
        return scores[metric], f"{left_out} pictures without a finite score are not in the mean"
    return scores[metric], ""


def _text(metric: str, summary: Summary, *, signed: bool = False) -> str:
    mean = shown(metric, summary.mean, signed=signed)
    return mean if summary.spread is None else f"{mean} ± {shown(metric, summary.spread)}"


def _numbers(summary: Summary, by_seed: Mapping[Any, float]) -> dict[str, Any]:
    seeds = {str(seed): value for seed, value in by_seed.items()}
    return {"mean": summary.mean, "spread": summary.spread, "n": summary.n, "seeds": seeds}


@dataclass(frozen=True)
class Summary:
    """Several seeds' values as one.

    Args:
        mean: of the values.
        spread: their sample standard deviation (n − 1); None for one value, which has none.
        n: how many.
    """

    mean: float
    spread: float | None
    n: int


def summarise(values: Sequence[float]) -> Summary | None:
    """Mean and sample standard deviation; None of no values."""
    if not values:
        return None
    spread = stdev(values) if len(values) > 1 else None
    return Summary(fmean(values), spread, len(values))


@dataclass(frozen=True)
class Difference:
    """What one variant has over another, seed by seed.

    Args:
        summary: of the differences.
        by_seed: each of them.
        agreeing: how many of them have their mean's sign.
    """

    summary: Summary
    by_seed: Mapping[int, float]
    agreeing: int


def paired(values: Mapping[int, float], reference: Mapping[int, float]) -> Difference | None:
    """``values - reference`` over the seeds that both have; None where there is no such seed."""
    found = {seed: values[seed] - reference[seed] for seed in sorted(set(values) & set(reference))}
    summary = summarise(list(found.values()))
    if summary is None:
        return None
    agreeing = sum(_sign(value) == _sign(summary.mean) for value in found.values())
    return Difference(summary, found, agreeing)


def _sign(value: float) -> int:
    return (value > 0) - (value < 0)
