"""What the raster bench found, for people (Markdown, pictures) and for programs (CSV, JSON)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from gsgan.bench.environment import Environment
from gsgan.bench.raster_cell import Row
from gsgan.bench.raster_marks import Line, Marks, verdict
from gsgan.bench.tables import NOTHING, csv_text, fill_block, markdown, number
from gsgan.utils.files import write_atomically

HEADER = (
    "N", "C", "size", "backend", "setting", "forward ms", "forward + backward ms",
    "largest error", "mean error", "proven bound", "gradient error", "worst group",
    "largest gradient error", "peak MB",
)  # fmt: skip
COLUMNS = (
    "gaussians", "channels", "size", "backend", "setting", "forward_ms", "both_ms",
    "value_max", "value_mean", "bound", "beyond", "gradient", "gradient_max", "memory_mb",
)  # fmt: skip
PICTURES = ("raster_error.png", "raster_growth.png")
GROWTH_SETTING = "standard"  # of the table of times over the whole grid


@dataclass(frozen=True)
class Report:
    """Everything that one run found.

    Args:
        rows: of all cells.
        reference: ``gaussians`` and ``size`` that the verdict is about.
        marks: what must be reached.
        rounding: of float32, on top of the proven bounds.
        auto: the backend that ``auto`` takes, by setting.
        where: the machine.
    """

    rows: Sequence[Row]
    reference: dict[str, int]
    marks: Marks
    rounding: float
    auto: dict[str, str]
    where: Environment

    @property
    def at_reference(self) -> list[Row]:
        """The rows that the verdict is about."""
        n, size = self.reference["gaussians"], self.reference["size"]
        return [row for row in self.rows if (row.gaussians, row.size) == (n, size)]

    @property
    def verdict(self) -> list[Line]:
        """Every mark with what was found."""
        return verdict(self.rows, self.reference, self.marks, self.rounding, self.auto)


def cells(row: Row) -> list[str]:
    """A row of the big table, formatted."""
    worst = NOTHING
    if row.gradients:
        worst = max(row.gradients, key=row.gradients.__getitem__)
    return [
        str(row.gaussians), str(row.channels), f"{row.size}²", row.backend, row.setting,
        number(row.forward_ms), number(row.both_ms),
        number(row.value_max, 2), number(row.value_mean, 2), number(row.bound, 2),
        number(row.gradient, 2), worst, number(row.gradient_max, 2), number(row.memory_mb),
    ]  # fmt: skip


def verdict_table(lines: Sequence[Line]) -> str:
    """The verdict in Markdown."""
    rows = [[line.what, line.wanted, line.found, line.verdict] for line in lines]
    return markdown(("must reach", "wanted", "found", "verdict"), rows)


def growth_table(rows: Sequence[Row], setting: str = GROWTH_SETTING) -> str:
    """Forward / forward + backward milliseconds of one setting over the whole grid, Markdown."""
    chosen = [row for row in rows if row.setting == setting]
    kinds = sorted({(row.backend, row.channels) for row in chosen})
    found = {(row.gaussians, row.size, row.backend, row.channels): row for row in chosen}
    header = ["N", "size", *(f"{backend}, C={channels}" for backend, channels in kinds)]
    lines = []
    for n, size in sorted({(row.gaussians, row.size) for row in chosen}):
        times = [_both(found.get((n, size, *kind))) for kind in kinds]
        lines.append([str(n), f"{size}²", *times])
    return markdown(header, lines)


def _both(row: Row | None) -> str:
    if row is None:
        return NOTHING
    return f"{number(row.forward_ms)} / {number(row.both_ms)}"


def page(report: Report) -> str:
    """All of it in Markdown."""
    return "\n\n".join(
        [
            "# What accuracy costs in time",
            report.where.sentence(),
            "## Verdict",
            verdict_table(report.verdict),
            "## All rows",
            markdown(HEADER, [cells(row) for row in report.rows]),
            "",
        ]
    )


def summary(report: Report) -> str:
    """What the docs show: the reference scene, the growth, the verdict, the pictures."""
    n, size = report.reference["gaussians"], report.reference["size"]
    scene = f"{n} Gaussians at {size}²"
    rows = [cells(row) for row in report.at_reference]
    narrow = [[*row[1:2], *row[3:]] for row in rows]
    return "\n\n".join(
        [
            report.where.sentence() + ".",
            f"![time against error](pictures/{PICTURES[0]})",
            f"{scene}; medians of interleaved runs:",
            markdown((*HEADER[1:2], *HEADER[3:]), narrow),
            f"![time against Gaussians and pixels](pictures/{PICTURES[1]})",
            f"`{GROWTH_SETTING}`, milliseconds forward / forward + backward:",
            growth_table(report.rows),
            "What must be reached, and what was found in the same run:",
            verdict_table(report.verdict),
        ]
    )


def write(report: Report, folder: Path, settings: dict[str, Any]) -> None:
    """``raster.md``, ``raster.csv``, ``raster.json`` and the pictures, each whole or not at all."""
    write_atomically(folder / "raster.md", page(report))
    write_atomically(folder / "raster.csv", _csv(report.rows))
    numbers = {
        "where": report.where.as_dict(),
        "bench": settings,
        "rows": [asdict(row) for row in report.rows],
        "verdict": [asdict(line) for line in report.verdict],
    }
    write_atomically(folder / "raster.json", json.dumps(numbers, indent=1))
    _write_pictures(report, folder)


def write_docs(report: Report, docs: Path) -> None:
    """Rewrites the ``bench:raster`` block of a page, and the pictures in ``pictures/`` beside it.

    Raises:
        ConfigError: when the page is missing or has no such block.
    """
    fill_block(docs, "raster", summary(report))
    _write_pictures(report, docs.parent / "pictures")


def show(report: Report, console: Console) -> None:
    """Prints the reference scene and the verdict."""
    table = Table(title="at the reference scene")
    wanted = [*HEADER[1:2], *HEADER[3:8], HEADER[9], HEADER[10], HEADER[13]]
    for name in wanted:
        table.add_column(name, justify="left" if name in ("backend", "setting") else "right")
    for row in report.at_reference:
        shown = dict(zip(HEADER, cells(row), strict=True))
        table.add_row(*(shown[name] for name in wanted))
    lines = Table(title="must reach")
    for name in ("", "wanted", "found", "verdict"):
        lines.add_column(name)
    for line in report.verdict:
        lines.add_row(line.what, line.wanted, line.found, line.verdict)
    console.print(table)
    console.print(lines)


def _csv(rows: Sequence[Row]) -> str:
    groups = sorted({name for row in rows for name in row.gradients or ()})
    header = [*COLUMNS, *(f"gradient_{name}" for name in groups)]
    lines = [
        [*(getattr(row, name) for name in COLUMNS), *((row.gradients or {}).get(g) for g in groups)]
        for row in rows
    ]
    return csv_text(header, lines)


def _write_pictures(report: Report, folder: Path) -> None:
    from gsgan.bench import raster_plots  # here: matplotlib is slow to load

    write_atomically(folder / PICTURES[0], raster_plots.error_picture(report.at_reference))
    write_atomically(
        folder / PICTURES[1], raster_plots.growth_picture(report.rows, report.reference)
    )
