"""Means and spreads over seeds, and differences between runs of the same seed."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


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
    spread = statistics.stdev(values) if len(values) > 1 else None
    return Summary(statistics.fmean(values), spread, len(values))


@dataclass(frozen=True)
class Difference:
    """What one variant has over another, seed by seed.

    Args:
        summary: of the differences.
        agreeing: how many of them have their mean's sign.
    """

    summary: Summary
    agreeing: int


def paired(values: Mapping[int, float], reference: Mapping[int, float]) -> Difference | None:
    """``values - reference`` over the seeds that both have; None where there is no such seed."""
    differences = [values[seed] - reference[seed] for seed in sorted(set(values) & set(reference))]
    summary = summarise(differences)
    if summary is None:
        return None
    agreeing = sum(_sign(value) == _sign(summary.mean) for value in differences)
    return Difference(summary, agreeing)


def _sign(value: float) -> int:
    return (value > 0) - (value < 0)
