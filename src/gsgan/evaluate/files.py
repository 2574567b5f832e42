"""The files of an evaluation: metrics.json, scores.csv, facts.json, metrics.md."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from gsgan.evaluate.facts import same
from gsgan.evaluate.scores import METRICS
from gsgan.evaluate.tables import Results, markdown
from gsgan.utils.files import write_atomically

METRICS_FILE, SCORES_FILE, FACTS_FILE, TABLE_FILE = NAMES = (
    *("metrics.json", "scores.csv", "facts.json", "metrics.md"),
)
PLACE = {"split": str, "variant": str, "camera": str, "frame": int}
HEADER = (*PLACE, *METRICS)


@dataclass(frozen=True)
class Scored:
    """All scores of one method on one dataset.

    Args:
        results: ``{split: {variant: {metric: value}}}``, as in metrics.json.
        rows: per image, with the columns `HEADER`; an undefined score is NaN.
        facts: as in facts.json.
    """

    results: Results
    rows: pd.DataFrame
    facts: dict[str, Any]


def write_scored(scored: Scored, folder: Path, title: str) -> None:
    """Writes the four files, each whole or not at all; metrics.json last: if it is new, all are."""
    facts = json.dumps(scored.facts, indent=2, allow_nan=False)
    table = scored.rows.to_csv(columns=list(HEADER), index=False, lineterminator="\n")
    write_atomically(folder / SCORES_FILE, table)
    write_atomically(folder / TABLE_FILE, markdown(scored.results, scored.facts, title))
    write_atomically(folder / FACTS_FILE, facts)
    results = json.dumps(scored.results, indent=2, allow_nan=False)
    write_atomically(folder / METRICS_FILE, results)


def read_rows(path: Path) -> pd.DataFrame:
    """Reads scores.csv.

    Raises:
        ValueError: when it is another table.
        OSError: when it cannot be read.
    """
    empty: dict[str, list[str]] = {metric: [""] for metric in METRICS}
    table = pd.read_csv(
        path, dtype=PLACE, keep_default_na=False, na_values=empty, float_precision="round_trip"
    )
    if tuple(table.columns) != HEADER:
        raise ValueError(f"{path}: other columns")
    return table


def joined(now: Scored, folder: Path, splits: Iterable[str]) -> tuple[Scored, list[str]]:
    """Adds the earlier scores of other splits where they were made in the same way.

    Args:
        now: the new scores.
        folder: of the earlier ones.
        splits: in the order of the table.

    Returns:
        All scores, and the names of earlier splits that had to be dropped.
    """
    path = folder / METRICS_FILE
    if not path.is_file():
        return now, []
    others: list[str] = []
    try:
        results: Results = json.loads(path.read_text())
        others = [split for split in results if split not in now.results]
        facts = json.loads((folder / FACTS_FILE).read_text())
        rows = read_rows(folder / SCORES_FILE)
        fits = same(facts, now.facts) and all(
            _way(results[split]["full"]) == _way(scored["full"])
            for split in others
            for scored in now.results.values()
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        fits = False  # damaged, or of a version without facts
    if not fits:
        return now, others
    results |= now.results
    rows = pd.concat([rows[rows["split"].isin(others)], now.rows])
    order = [split for split in splits if split in results]
    rows = pd.concat([rows[rows["split"] == split] for split in order])
    return Scored({split: results[split] for split in order}, rows, now.facts), []


def _way(scores: dict[str, Any]) -> tuple[Any, ...]:
    """How a variant was scored."""
    return scores["marks"], scores.get("protocol"), scores["lpips_name"]
