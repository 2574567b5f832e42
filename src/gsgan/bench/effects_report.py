"""What ``bench effects`` found: JSON, a Markdown table, the verdict."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from gsgan.bench.effects_case import Row
from gsgan.bench.environment import Environment
from gsgan.bench.tables import NOTHING, fill_block, markdown
from gsgan.utils.files import write_atomically

HEADER = (
    *("effect", "scene", "auto", "gain dB", "Step I dB", "held out", "paint ms", "read ms"),
    "parameters",
)


@dataclass(frozen=True)
class Report:
    """All that was found.

    Args:
        rows: one an effect and scene.
        where: it was measured.
    """

    rows: list[Row]
    where: Environment

    @property
    def failures(self) -> list[str]:
        """What is not as it must be, a clause each."""
        found = []
        for row in self.rows:
            name = f"{row.effect} in the scene {row.scene}"
            if row.auto is not None and row.auto != row.called:
                state = "on" if row.auto else "off"
                found.append(f"auto leaves {name} {state} ({row.why})")
            gain = row.gain("full")
            if row.called and gain is not None and gain <= 0:
                found.append(f"{name} gains {gain:+.2f} dB although it is called for")
        return found

    @property
    def marks(self) -> list[str]:
        """Stand-ins that the table must name."""
        return sorted({mark for row in self.rows for mark in row.marks})


def table(report: Report) -> str:
    """One row an effect and scene."""
    return markdown(HEADER, [cells(row) for row in report.rows])


def cells(row: Row) -> list[str]:
    """A row of the table."""
    auto = NOTHING if row.auto is None else ("on" if row.auto else "off")
    right = "" if row.auto is None or row.auto == row.called else " (wrong)"
    return [
        row.effect,
        row.scene,
        f"{auto}{right}: {row.why}" if row.why else auto,
        _gain(row, "full"),
        _gain(row, "splat"),
        row.split,
        _change(row.paint_ms),
        _change(row.read_ms),
        _parameters(row.parameters),
    ]


def _gain(row: Row, variant: str) -> str:
    gain = row.gain(variant)
    if gain is None:
        return NOTHING
    off, on = row.scores["off"][variant], row.scores["on"][variant]
    return f"{gain:+.2f} ({off:.2f} → {on:.2f})"


def _change(times: dict[str, float | None]) -> str:
    off, on = times.get("off"), times.get("on")
    return NOTHING if off is None or on is None else f"{off:.2f} → {on:.2f}"


def _parameters(counts: dict[str, int]) -> str:
    return f"{counts['on'] - counts['off']:+,}" if set(counts) == {"on", "off"} else NOTHING


def text(report: Report) -> str:
    """The table with what it needs to be understood."""
    parts = [
        f"{report.where.sentence()}. PSNR in the person's box on held-out pictures, effect off → "
        "on, of the final picture and of Step I's colour; one seed. Milliseconds a frame for "
        "painting and for reading from disk, off and on in turn, medians.",
        table(report),
    ]
    parts += [f"Stand-in in use: {mark}." for mark in report.marks]
    return "\n\n".join(parts)


def write(report: Report, folder: Path, settings: dict[str, Any]) -> None:
    """``effects.json`` and ``effects.md`` in the folder."""
    rows = [
        asdict(row) | {"gain_db": {v: row.gain(v) for v in ("full", "splat")}}
        for row in report.rows
    ]
    record = {
        "where": report.where.as_dict(),
        "settings": settings,
        "rows": rows,
        "failures": report.failures,
    }
    write_atomically(folder / "effects.json", json.dumps(record, indent=1))
    write_atomically(folder / "effects.md", f"# What effects gain and cost\n\n{text(report)}\n")


def write_docs(report: Report, page: Path) -> None:
    """Rewrites the ``bench:effects`` block of a page."""
    fill_block(page, "effects", text(report))


def show(report: Report, console: Console) -> None:
    """Prints it."""
    console.print(text(report), markup=False, highlight=False)
