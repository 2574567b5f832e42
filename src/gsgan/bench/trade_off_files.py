"""The trade-off bench's files: Markdown, CSV, JSON, pictures, and the block of a page."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

from gsgan.bench.tables import csv_text, fill_block
from gsgan.bench.trade_off_plots import trade_off_picture, training_picture
from gsgan.bench.trade_off_report import Report, Row
from gsgan.utils.files import write_atomically

PICTURES = ("trade_off.png", "trade_off_training.png")


def write(report: Report, folder: Path) -> None:
    """``trade_off.md``, ``.csv``, ``.json`` and the pictures."""
    names = [field.name for field in fields(Row)]
    values = [[getattr(row, name) for name in names] for row in report.rows]
    write_atomically(folder / "trade_off.md", f"# Quality against time\n\n{report.text()}")
    write_atomically(folder / "trade_off.csv", csv_text(names, values))
    write_atomically(folder / "trade_off.json", json.dumps(report.as_dict(), indent=1))
    for name, png in drawn(report).items():
        write_atomically(folder / name, png)


def drawn(report: Report) -> dict[str, bytes]:
    """The pictures by name; without curves there is only one."""
    found = {PICTURES[0]: trade_off_picture(report)}
    if report.curves:
        found[PICTURES[1]] = training_picture(report.curves)
    return found


def write_docs(report: Report, page: Path) -> None:
    """The page's block ``bench:trade-off``, its pictures in ``pictures/`` beside the page."""
    lines = [report.text()]
    captions = ("Quality against time a frame", "Quality against time of training")
    for (name, png), caption in zip(drawn(report).items(), captions, strict=False):
        write_atomically(page.parent / "pictures" / name, png)
        lines.append(f"![{caption}](pictures/{name})")
    fill_block(page, "trade-off", "\n\n".join(lines))
