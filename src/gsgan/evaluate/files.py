"""What a scoring leaves behind: metrics.json, scores.csv, facts.json, metrics.md."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsgan.evaluate.facts import same
from gsgan.evaluate.scores import METRICS, Row
from gsgan.evaluate.tables import Results, markdown
from gsgan.utils.files import write_atomically

METRICS_FILE, SCORES_FILE, FACTS_FILE, TABLE_FILE = NAMES = (
    *("metrics.json", "scores.csv", "facts.json", "metrics.md"),
)
HEADER = ("split", "variant", "camera", "frame", *METRICS)
Rows = dict[str, dict[str, list[Row]]]  # by split and variant


@dataclass(frozen=True)
class Scored:
    """All scores of one method on one dataset.

    Args:
        results: ``{split: {variant: {metric: value}}}``, as in metrics.json.
        rows: of single pictures.
        facts: as in facts.json.
    """

    results: Results
    rows: Rows
    facts: dict[str, Any]


def write_scored(scored: Scored, folder: Path, title: str) -> None:
    """Writes the four files, each whole or not at all; metrics.json comes last: where it is new,
    the others are."""
    facts = json.dumps(scored.facts, indent=2, allow_nan=False)
    write_atomically(folder / SCORES_FILE, csv_text(scored.rows))
    write_atomically(folder / TABLE_FILE, markdown(scored.results, scored.facts, title))
    write_atomically(folder / FACTS_FILE, facts)
    results = json.dumps(scored.results, indent=2, allow_nan=False)
    write_atomically(folder / METRICS_FILE, results)


def csv_text(rows: Rows) -> str:
    """One line a picture and variant, all digits; an undefined score is empty, equal pictures have
    a PSNR of inf."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(HEADER)
    for split, variants in rows.items():
        for variant, of_variant in variants.items():
            for row in of_variant:
                scores = (_text(row.scores.get(metric)) for metric in METRICS)
                writer.writerow([split, variant, row.camera, row.frame, *scores])
    return stream.getvalue()


def _text(score: float | None) -> str:
    return "" if score is None or math.isnan(score) else repr(score)


def read_rows(path: Path) -> Rows:
    """What `csv_text` wrote.

    Raises:
        ValueError: when it is another table.
        OSError: when it cannot be read.
    """
    found: Rows = {}
    with path.open(newline="", encoding="utf-8") as stream:
        reader = csv.reader(stream)
        if tuple(next(reader, ())) != HEADER:
            raise ValueError(f"{path}: other columns")
        for split, variant, camera, frame, *scores in reader:
            values = zip(METRICS, scores, strict=True)
            row = Row(camera, int(frame), {m: float(s) for m, s in values if s})
            found.setdefault(split, {}).setdefault(variant, []).append(row)
    return found


def joined(now: Scored, folder: Path, splits: Iterable[str]) -> tuple[Scored, list[str]]:
    """The scores with those of other splits that were made before in the same way, so that scoring
    one split does not lose the other.

    Args:
        now: just made.
        folder: where the earlier ones lie.
        splits: in the order of the table.

    Returns:
        The whole, and the names of earlier splits that no longer belong to it.
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
    rows |= now.rows
    order = [split for split in splits if split in results]
    kept = {split: rows[split] for split in order if split in rows}
    return Scored({split: results[split] for split in order}, kept, now.facts), []


def _way(scores: dict[str, Any]) -> tuple[Any, ...]:
    """How a variant was scored, LPIPS' name only where there was something to score."""
    name = scores["lpips_name"]
    return scores["marks"], scores.get("protocol"), name
