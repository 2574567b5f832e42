"""The results of an evaluation: metrics.json, scores.csv, facts.json and tables of the scores."""

import json
from collections.abc import Iterator, Mapping, Sequence
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
# The first tables; those without any score are left out.
SHOWN = (
    "psnr",
    "psnr_person",
    "lpips_vgg",
    "lpips_alex",
    "ssim",
    "miou",
    "psnr_hands",
)
OVER_POSES = "± over poses"
SPREAD = (
    f"{OVER_POSES}: standard deviation over poses of the mean of their images"
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


def list_metrics(results: Results) -> list[str]:
    """The metrics of the first tables, those that any split has."""
    finals = [variants[FULL] for variants in results.values()]
    return [
        metric
        for metric in SHOWN
        if any(scores[metric] is not None for scores in finals)
    ]


def format_score(values: Mapping[str, Any], metric: str, end: str = "") -> str:
    """A score, rounded to the digits of its metric; None is ``n/a``."""
    value = values.get(metric + end)
    if value is None:
        return "n/a"
    return f"{value:.{METRICS[metric].digits}f}"


def rows(
    variants: Mapping[str, dict[str, Any]],
    metrics: Sequence[str],
    *,
    cameras: bool = False,
) -> Iterator[list[str]]:
    """One formatted row per variant of a split, and below it one of the deviation over poses or,
    if ``cameras``, one per camera."""
    for variant, scores in variants.items():
        yield [VARIANTS[variant], *(format_score(scores, x) for x in metrics)]
        if cameras:
            for camera, means in scores["cameras"].items():
                yield [
                    f"  {camera}",
                    *(format_score(means, x) for x in metrics),
                ]
        elif any(f"{metric}_over_poses" in scores for metric in metrics):
            cells = [format_score(scores, x, "_over_poses") for x in metrics]
            yield [f"  {OVER_POSES}", *cells]


def notes(results: Results) -> list[str]:
    """Every reason and mark of the table, once each."""
    # Keys of a dictionary: each note once, in the order of the table.
    lines: dict[str, None] = {}
    for split, variants in results.items():
        scores = variants[FULL]
        lines |= dict.fromkeys(_spread_notes(scores))

        # The inputs of the metrics, and marks.
        described = scores.get("lpips_input")
        if described:
            lines[f"LPIPS' networks get {described}"] = None
        boxes = scores.get("boxes")
        if boxes:
            lines[f"boxes: {boxes}"] = None
        for mark in scores["marks"]:
            lines[f"marked: {mark}"] = None

        # The protocol is the same for every split, and so is its note.
        if scores.get("protocol"):
            lines |= dict.fromkeys(_protocol_notes(scores["protocol"]))

        # Why there is no score, by reason.
        if not scores["images"]:
            lines[f"{split}: {scores['psnr_reason']}"] = None
            continue

        # Metrics that lack for the same reason share a note.
        missing: dict[str, list[str]] = {}
        for metric in METRICS:
            if scores[metric] is None:
                missing.setdefault(scores[f"{metric}_reason"], []).append(
                    metric
                )
        for reason, metrics in missing.items():
            lines[f"{', '.join(metrics)} n/a: {reason}"] = None
    return list(lines)


def _spread_notes(scores: Mapping[str, Any]) -> list[str]:
    """What the deviations over poses are, if there are any."""
    some = any(key.endswith("_over_poses") for key in scores)
    return [SPREAD] if some else []


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
    table = Table(title=TITLE, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("image", no_wrap=True)
    metrics = list_metrics(results)
    for metric in metrics:
        heading = METRICS[metric].short_heading
        table.add_column(heading, justify="right", no_wrap=True)

    # The split is a row of its own: a column for it would not fit a narrow terminal.
    for split, variants in results.items():
        table.add_section()
        images = variants[FULL]["images"]
        table.add_row(f"[bold]{split}[/bold], {images} images")
        for row in rows(variants, metrics):
            table.add_row(*row)

    # The caption and the notes are not part of the table: they would widen its columns.
    console.print(table)
    for line in (caption(origin), *notes(results)):
        console.print(f"  {line}", markup=False, highlight=False)


def markdown(results: Results, origin: dict[str, Any]) -> str:
    """The tables in Markdown with their caption: a few metrics for reading, then every metric, and
    the few by camera."""
    metrics = list_metrics(results)
    headings = [METRICS[metric].short_heading for metric in metrics]
    first = []
    whole = ["## All metrics"]
    by_camera = ["## By camera"]
    for split, variants in results.items():
        # A few metrics.
        header = ["image", *headings]
        images = variants[FULL]["images"]
        first.append(f"**{split}**, {images} images")
        first.append(pages.markdown(header, list(rows(variants, metrics))))

        # Every metric is a row, so that the table is narrow.
        lines = []
        for metric, described in METRICS.items():
            cells = [
                format_score(scores, metric) for scores in variants.values()
            ]
            lines.append([described.heading, *cells])
        names = [VARIANTS[variant] for variant in variants]
        whole += [f"**{split}**", pages.markdown(["metric", *names], lines)]

        # The few by camera.
        cameras = list(rows(variants, metrics, cameras=True))
        by_camera += [f"**{split}**", pages.markdown(header, cameras)]

    # Notes follow the tables for reading.
    listed = "\n".join(f"- {note}" for note in notes(results))
    parts = (f"# {TITLE}", caption(origin), *first, listed, *whole, *by_camera)
    return "\n\n".join(filter(None, parts)) + "\n"
