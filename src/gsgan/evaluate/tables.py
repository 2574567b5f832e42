"""Tables of results: in the terminal and in Markdown."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from gsgan.evaluate.facts import caption, provenance
from gsgan.evaluate.scores import METRICS
from gsgan.utils import pages

Results = dict[str, dict[str, dict[str, Any]]]
COLUMNS = {  # heading and number of decimals
    "psnr": ("PSNR ↑", 2),
    "psnr_person": ("in box ↑", 2),
    "ssim": ("SSIM ↑", 4),
    "ssim_person": ("SSIM in box ↑", 4),
    "lpips": ("LPIPS ↓", 4),
    "lpips_person": ("LPIPS in box ↓", 4),
    "edge_f1": ("edge F1 ↑", 3),
    "edge_f1_person": ("edge F1 in box ↑", 3),
    "edge_ratio": ("edges →1", 2),
    "edge_ratio_person": ("edges in box →1", 2),
    "high_frequencies": ("detail →1", 2),
    "miou": ("mIoU ↑", 3),
    "miou_with_background": ("with background ↑", 3),
}
NOT_IN_TERMINAL = (  # narrow terminals; metrics.md has all metrics
    *("ssim_person", "lpips_person", "edge_f1_person", "edge_ratio_person"),
    "miou_with_background",
)
IN_TERMINAL = tuple(m for m in METRICS if m not in NOT_IN_TERMINAL)
VARIANTS = {"full": "picture", "splat": "Step I's colour", "floor": "floor: background"}
PER = ("split", "camera")


def rows(
    results: Results, metrics: tuple[str, ...] = METRICS, per: str = "split"
) -> Iterator[list[str]]:
    """One formatted row per split and variant; what is None shows as ``n/a``.

    Args:
        results: as in metrics.json.
        metrics: columns.
        per: "camera" adds a row per camera below each variant.
    """

    def formatted(values: dict[str, Any]) -> list[str]:
        return ["n/a" if (v := values[m]) is None else f"{v:.{COLUMNS[m][1]}f}" for m in metrics]

    for split, variants in results.items():
        for variant, scores in variants.items():
            yield [split, VARIANTS[variant], str(scores["images"]), *formatted(scores)]
            for camera, means in scores["cameras"].items() if per == "camera" else ():
                yield [split, f"  {camera}", "", *formatted(means)]


def notes(results: Results) -> list[str]:
    """Every reason and mark behind the table, once each."""
    found: dict[str, None] = {}
    for split, variants in results.items():
        scores = variants["full"]
        if name := scores.get("lpips_name"):
            found[f"LPIPS is {name}"] = None
        for mark in scores["marks"]:
            found[f"marked: {mark}"] = None
        if protocol := scores.get("protocol"):
            note = f"; {protocol['note']}" if protocol.get("note") else ""
            found[f"protocol: {protocol['name']} ({protocol['source']}){note}"] = None
            for departure in protocol["departures"]:
                found[f"departs from {protocol['name']}: {departure}"] = None
        if not scores["images"]:
            found[f"{split}: {scores['psnr_reason']}"] = None
            continue
        for metric in METRICS:
            repeats = metric in ("miou_with_background", "lpips_person")  # miou's, lpips' reason
            if not repeats and scores[metric] is None:
                found[f"{metric} n/a: {scores[f'{metric}_reason']}"] = None
    return list(found)


def print_table(
    results: Results, facts: dict[str, Any], console: Console, title: str, per: str = "split"
) -> None:
    """Prints the table, its caption and its notes.

    Args:
        results: as in metrics.json.
        facts: as in facts.json.
        console: to print on.
        title: of the table.
        per: "split" or "camera".
    """
    table = Table(title=title, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("picture", no_wrap=True)
    for metric in IN_TERMINAL:
        table.add_column(COLUMNS[metric][0], justify="right", no_wrap=True)
    previous = None
    for split, variant, images, *scores in rows(results, IN_TERMINAL, per):
        if split != previous:  # a column for the split would not fit a narrow terminal
            table.add_section()
            table.add_row(f"[bold]{split}[/bold], {images} images")
            previous = split
        table.add_row(variant, *scores)
    console.print(table)
    for line in (caption(facts), *notes(results)):
        console.print(f"  {line}", markup=False, highlight=False)


def markdown(results: Results, facts: dict[str, Any], title: str) -> str:
    """The table in Markdown with every metric, and again by camera; rows carry the provenance."""
    source = provenance(facts)
    header = ["split", "picture", "images", *(COLUMNS[m][0] for m in METRICS), *source]
    by_split, by_camera = (
        pages.markdown(header, [[*row, *source.values()] for row in rows(results, per=per)])
        for per in PER
    )
    listed = "\n".join(f"- {note}" for note in notes(results))
    parts = (f"# {title}", caption(facts), by_split, listed, "## By camera", by_camera)
    return "\n\n".join(filter(None, parts)) + "\n"
