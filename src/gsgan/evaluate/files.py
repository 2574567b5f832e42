"""The results of an evaluation: metrics.json, scores.csv, facts.json and tables of the scores."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd
from rich import box
from rich.console import Console
from rich.table import Table

from gsgan.evaluate.origin import caption
from gsgan.metrics.names import FULL, METRICS, VARIANTS
from gsgan.utils import pages
from gsgan.utils.files import write_atomically

METRICS_FILE = "metrics.json"
SCORES_FILE = "scores.csv"
FACTS_FILE = "facts.json"
TABLE_FILE = "metrics.md"
NAMES = (METRICS_FILE, SCORES_FILE, FACTS_FILE, TABLE_FILE)
# Columns of scores.csv.
HEADER = ("split", "variant", "camera", "frame", *METRICS)
# {split: {variant: {metric: value}}}
Results = dict[str, dict[str, dict[str, Any]]]
TITLE = "Held-out cameras (novel_view) and poses (novel_pose)"
# A terminal is narrow; metrics.md has all metrics.
IN_TERMINAL = (
    "psnr",
    "psnr_person",
    "ssim",
    "lpips_vgg",
    "lpips_alex",
    "high_frequencies",
    "miou",
)
# the columns if hands are scored
WITH_HANDS = (
    "psnr",
    "psnr_person",
    "psnr_hands",
    "psnr_mouth",
    "ssim",
    "lpips_alex",
    "miou",
)


@dataclass(frozen=True)
class Scored:
    """All scores of one method on one dataset.

    Args:
        results: ``{split: {variant: {metric: value}}}``, as in metrics.json.
        rows: per image, with the columns `HEADER`; an undefined score is NaN.
        origin: as in facts.json.
    """

    results: Results
    rows: pd.DataFrame
    origin: dict[str, Any]


def images_scored(folder: Path) -> int:
    """The number of images that a folder's scores are of, in the split with most; 0 without
    scores."""
    path = folder / SCORES_FILE
    if not path.is_file():
        return 0
    rows = pd.read_csv(path)
    counts = rows.loc[rows["variant"] == FULL, "split"].value_counts()
    return int(counts.max()) if len(counts) else 0


def write_scored(scored: Scored, folder: Path) -> None:
    """Writes the four files atomically; metrics.json is last, so if it is new, all of them are."""
    # Everything is formatted before the first file is written.
    origin = json.dumps(scored.origin, indent=2, allow_nan=False)
    table = scored.rows.to_csv(
        columns=list(HEADER), index=False, lineterminator="\n"
    )
    write_atomically(folder / SCORES_FILE, table)
    write_atomically(
        folder / TABLE_FILE, markdown(scored.results, scored.origin)
    )
    write_atomically(folder / FACTS_FILE, origin)

    # The last file.
    results = json.dumps(scored.results, indent=2, allow_nan=False)
    write_atomically(folder / METRICS_FILE, results)


# -- tables


def rows(
    results: Results,
    metrics: Sequence[str] = tuple(METRICS),
    *,
    cameras: bool = False,
) -> Iterator[list[str]]:
    """One formatted row per split and variant, and per camera if ``cameras``; None is ``n/a``."""

    def formatted(values: dict[str, Any]) -> list[str]:
        # Rounded to the digits of each metric.
        cells = []
        for metric in metrics:
            value = values[metric]
            digits = METRICS[metric].digits
            cells.append("n/a" if value is None else f"{value:.{digits}f}")
        return cells

    # One row per variant, and below it one per camera.
    for split, variants in results.items():
        for variant, scores in variants.items():
            yield [
                split,
                VARIANTS[variant],
                str(scores["images"]),
                *formatted(scores),
            ]
            if cameras:
                for camera, means in scores["cameras"].items():
                    yield [split, f"  {camera}", "", *formatted(means)]


def notes(results: Results) -> list[str]:
    """Every reason and mark of the table, once each."""
    # Keys of a dictionary: each note once, in the order of the table.
    found: dict[str, None] = {}
    for split, variants in results.items():
        scores = variants[FULL]

        # The inputs of the metrics, and marks.
        described = scores.get("lpips_input")
        if described:
            found[f"LPIPS' networks get {described}"] = None
        boxes = scores.get("boxes")
        if boxes:
            found[f"boxes: {boxes}"] = None
        for mark in scores["marks"]:
            found[f"marked: {mark}"] = None

        # The protocol is the same for every split, and so is its note.
        if scores.get("protocol"):
            found |= dict.fromkeys(_protocol_notes(scores["protocol"]))

        # Why there is no score, by reason.
        if not scores["images"]:
            found[f"{split}: {scores['psnr_reason']}"] = None
            continue

        # Metrics that lack for the same reason share a note.
        missing: dict[str, list[str]] = {}
        for metric in METRICS:
            if scores[metric] is None:
                missing.setdefault(scores[f"{metric}_reason"], []).append(
                    metric
                )
        for reason, metrics in missing.items():
            found[f"{', '.join(metrics)} n/a: {reason}"] = None
    return list(found)


def _protocol_notes(protocol: dict[str, Any]) -> Iterator[str]:
    """The protocol, and the departures from it."""
    # A remark of the protocol follows its source.
    note = f"; {protocol['note']}" if protocol.get("note") else ""
    yield f"protocol: {protocol['name']} ({protocol['source']}){note}"
    for departure in protocol["departures"]:
        yield f"departs from {protocol['name']}: {departure}"


def print_table(
    results: Results, origin: dict[str, Any], console: Console
) -> None:
    """Prints the table, its caption and its notes."""
    # Columns of metrics; those of hands only if they were scored.
    table = Table(title=TITLE, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("variant", no_wrap=True)
    hands = any(
        scores[FULL]["psnr_hands"] is not None for scores in results.values()
    )
    shown = WITH_HANDS if hands else IN_TERMINAL
    for metric in shown:
        table.add_column(
            METRICS[metric].short_heading, justify="right", no_wrap=True
        )

    # The split is a row of its own: a column for it would not fit a narrow terminal.
    previous = None
    for split, variant, images, *scores in rows(results, shown):
        if split != previous:
            table.add_section()
            table.add_row(f"[bold]{split}[/bold], {images} images")
            previous = split
        table.add_row(variant, *scores)

    # The caption and the notes are not part of the table: they would widen its columns.
    console.print(table)
    for line in (caption(origin), *notes(results)):
        console.print(f"  {line}", markup=False, highlight=False)


def markdown(results: Results, origin: dict[str, Any]) -> str:
    """The table in Markdown with its caption and every metric, and again by camera."""
    # Every metric is a column.
    header = ["split", "variant", "images"]
    for metric in METRICS.values():
        header.append(metric.short_heading)
    by_split = pages.markdown(header, list(rows(results)))
    by_camera = pages.markdown(header, list(rows(results, cameras=True)))
    listed = "\n".join(f"- {note}" for note in notes(results))

    # An empty list of notes takes no line.
    parts = (
        f"# {TITLE}",
        caption(origin),
        by_split,
        listed,
        "## By camera",
        by_camera,
    )
    return "\n\n".join(filter(None, parts)) + "\n"
