"""Results for people: a table in the terminal and in Markdown."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from gsgan.evaluate.facts import caption, provenance
from gsgan.evaluate.scores import METRICS

Results = dict[str, dict[str, dict[str, Any]]]
HEADINGS = {
    "psnr": "PSNR ↑",
    "psnr_person": "in box ↑",
    "ssim": "SSIM ↑",
    "ssim_person": "SSIM in box ↑",
    "lpips": "LPIPS ↓",
    "lpips_person": "LPIPS in box ↓",
    "edge_f1": "edge F1 ↑",
    "edge_f1_person": "edge F1 in box ↑",
    "edge_ratio": "edges →1",
    "edge_ratio_person": "edges in box →1",
    "high_frequencies": "detail →1",
    "miou": "mIoU ↑",
    "miou_with_background": "with background ↑",
}
NOT_IN_TERMINAL = (  # a narrow one; metrics.md has them all
    *("ssim_person", "lpips_person", "edge_f1_person", "edge_ratio_person"),
    "miou_with_background",
)
IN_TERMINAL = tuple(m for m in METRICS if m not in NOT_IN_TERMINAL)
_DIGITS = {
    "psnr": 2, "psnr_person": 2, "ssim": 4, "ssim_person": 4, "lpips": 4, "lpips_person": 4,
    "edge_f1": 3, "edge_f1_person": 3, "edge_ratio": 2, "edge_ratio_person": 2,
    "high_frequencies": 2, "miou": 3, "miou_with_background": 3,
}  # fmt: skip
_VARIANTS = {
    "full": "picture",
    "splat": "Step I's colour",
    "floor": "floor: background",
}
PER = ("split", "camera")


def rows(
    results: Results, metrics: tuple[str, ...] = METRICS, per: str = "split"
) -> Iterator[list[str]]:
    """One row per split and variant, every value formatted; what cannot be had is ``n/a``.

    Args:
        results: as in metrics.json.
        metrics: columns.
        per: "camera" adds a row for each camera of a variant under it.
    """
    for split, variants in results.items():
        for variant, scores in variants.items():
            named = _VARIANTS.get(variant, variant)
            yield [split, named, str(scores["images"]), *(_format(m, scores[m]) for m in metrics)]
            for camera, means in scores["cameras"].items() if per == "camera" else ():
                yield [split, f"  {camera}", "", *(_format(m, means[m]) for m in metrics)]


def _format(metric: str, value: float | None) -> str:
    return "n/a" if value is None else f"{value:.{_DIGITS[metric]}f}"


def notes(results: Results) -> list[str]:
    """Every reason and mark behind the table, once each."""
    found: dict[str, None] = {}
    for split, variants in results.items():
        scored = variants["full"]
        if name := scored.get("lpips_name"):
            found[f"LPIPS is {name}"] = None
        for mark in scored["marks"]:
            found[f"marked: {mark}"] = None
        if protocol := scored.get("protocol"):
            note = f"; {protocol['note']}" if protocol.get("note") else ""
            found[f"protocol: {protocol['name']} ({protocol['source']}){note}"] = None
            for departure in protocol["departures"]:
                found[f"departs from {protocol['name']}: {departure}"] = None
        if not scored["images"]:
            found[f"{split}: {scored['psnr_reason']}"] = None
            continue
        for metric in METRICS:
            said = metric in ("miou_with_background", "lpips_person")  # beside the whole's
            if not said and scored[metric] is None:
                found[f"{metric} n/a: {scored[f'{metric}_reason']}"] = None
    return list(found)


def print_table(
    results: Results, held: dict[str, Any], console: Console, title: str, per: str = "split"
) -> None:
    """The rich table with its caption and notes underneath.

    Args:
        results: as in metrics.json.
        held: as in facts.json.
        console: to print on.
        title: over it.
        per: "split" or "camera".
    """
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("picture", no_wrap=True)
    for metric in IN_TERMINAL:
        table.add_column(HEADINGS[metric], justify="right", no_wrap=True)
    previous = None
    for split, picture, images, *scores in rows(results, IN_TERMINAL, per):
        if split != previous:  # a column of its own would not fit a narrow terminal
            table.add_section()
            table.add_row(f"[bold]{split}[/bold], {images} images")
            previous = split
        table.add_row(picture, *scores)
    console.print(table)
    for line in (caption(held), *notes(results)):
        console.print(f"  {line}", markup=False, highlight=False)


def markdown(results: Results, held: dict[str, Any], title: str) -> str:
    """The same table in Markdown, with every metric, and once more by camera; every row carries
    what it is of."""
    lines = [f"# {title}", "", caption(held), "", *_table(results, held, "split")]
    lines += ["", *(f"- {note}" for note in notes(results))]
    lines += ["", "## By camera", "", *_table(results, held, "camera")]
    return "\n".join([*lines, ""])


def _table(results: Results, held: dict[str, Any], per: str) -> list[str]:
    said = provenance(held)
    header = ["split", "picture", "images", *(HEADINGS[m] for m in METRICS), *said]
    table = ["| " + " | ".join(header) + " |", "|" + " --- |" * len(header)]
    return table + [
        "| " + " | ".join([*row, *said.values()]) + " |" for row in rows(results, per=per)
    ]
