"""Results for people (a table) and for programs (metrics.json)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from gsgan.files import write_atomically
from gsgan.metrics.evaluation import METRICS

Results = dict[str, dict[str, dict[str, Any]]]
HEADINGS = {
    "psnr": "PSNR ↑",
    "psnr_person": "in box ↑",
    "ssim": "SSIM ↑",
    "lpips": "LPIPS ↓",
    "edge_f1": "edge F1 ↑",
    "high_frequencies": "detail →1",
    "miou": "mIoU ↑",
}
_DIGITS = {
    "psnr": 2, "psnr_person": 2, "ssim": 4, "lpips": 4, "edge_f1": 3, "high_frequencies": 2,
    "miou": 3,
}  # fmt: skip
_VARIANTS = {
    "full": "I_pred",
    "splat": "Step I's colour",
    "floor": "floor: all background",
}


def rows(results: Results) -> list[list[str]]:
    """One row per split and variant, every value formatted; what cannot be had is ``n/a``."""
    return [
        [split, _VARIANTS.get(variant, variant), str(scores["images"])]
        + [_format(metric, scores[metric]) for metric in METRICS]
        for split, variants in results.items()
        for variant, scores in variants.items()
    ]


def _format(metric: str, value: float | None) -> str:
    return "n/a" if value is None else f"{value:.{_DIGITS[metric]}f}"


def notes(results: Results) -> list[str]:
    """Every reason and mark behind the table, once each."""
    found: dict[str, None] = {}
    for split, variants in results.items():
        scored = variants["full"]
        for mark in scored["marks"]:
            found[f"marked: {mark}"] = None
        if protocol := scored.get("protocol"):
            found[f"protocol: {protocol['name']} ({protocol['source']})"] = None
            for departure in protocol["departures"]:
                found[f"departs from {protocol['name']}: {departure}"] = None
        if not scored["images"]:
            found[f"{split}: {scored['psnr_reason']}"] = None
            continue
        for metric in METRICS:
            if scored[metric] is None:
                found[f"{metric} n/a: {scored[f'{metric}_reason']}"] = None
    return list(found)


def print_table(results: Results, console: Console, title: str) -> None:
    """The rich table with its notes underneath."""
    table = Table(title=title)
    table.add_column("picture", no_wrap=True)
    for metric in METRICS:
        table.add_column(HEADINGS[metric], justify="right", no_wrap=True)
    previous = None
    for split, picture, images, *scores in rows(results):
        if split != previous:  # a column of its own would not fit a narrow terminal
            table.add_section()
            table.add_row(f"[bold]{split}[/bold], {images} images")
            previous = split
        table.add_row(picture, *scores)
    console.print(table)
    for note in notes(results):
        console.print(f"  {note}", markup=False, highlight=False)


def markdown(results: Results, title: str) -> str:
    """The same table in Markdown."""
    header = ["split", "picture", "images", *(HEADINGS[m] for m in METRICS)]
    lines = [f"# {title}", "", "| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    lines += ["| " + " | ".join(row) + " |" for row in rows(results)]
    return "\n".join([*lines, "", *(f"- {note}" for note in notes(results)), ""])


def write_results(results: Results, folder: Path, title: str) -> None:
    """``metrics.json`` and ``metrics.md`` in the run folder, each whole or not at all."""
    write_atomically(folder / "metrics.json", json.dumps(results, indent=2, allow_nan=False))
    write_atomically(folder / "metrics.md", markdown(results, title))
