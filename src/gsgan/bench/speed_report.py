"""What the speed bench found, for people (Markdown, picture) and for programs (JSON)."""

from __future__ import annotations

import io
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from gsgan.bench.environment import Environment
from gsgan.bench.speed_stages import Spread, Times
from gsgan.bench.tables import markdown, number
from gsgan.utils.files import write_atomically

HEADER = ("stage", "median ms", "10 % below", "90 % below", "share")
BAR, WHISKER = "#0072b2", "#222222"


@dataclass(frozen=True)
class Report:
    """All of one run of the bench.

    Args:
        times: measured.
        memory_mb: peak, on top of the avatar and its inputs; None where the system does not tell.
        where: the machine.
        settings: name, picture, window, precision, accuracy and so on, for people and programs.
        marks: notes that the table must carry.
    """

    times: Times
    memory_mb: float | None
    where: Environment
    settings: dict[str, Any]
    marks: tuple[str, ...]

    @property
    def rows(self) -> list[tuple[str, Spread]]:
        """Stages, what no stage took, and end to end."""
        return [*self.times.stages.items(), ("between stages", self.times.rest)]

    def text(self) -> str:
        """The block of the page: where, how, the table, the notes."""
        total = self.times.total
        parts = sum(spread.median for _, spread in self.rows)
        table = [
            [name, *(number(v) for v in (s.median, s.p10, s.p90)), f"{s.median / parts:.0%}"]
            for name, s in self.rows
        ]
        ends = (number(v) for v in (total.median, total.p10, total.p90))
        table.append(["**end to end**", *ends, f"{1000 / total.median:.1f} frames/s"])
        how = ", ".join(f"{key} {value}" for key, value in self.settings.items())
        lines = [f"{self.where.sentence()}.", "", f"{how[0].upper()}{how[1:]}.", ""]
        lines += [markdown(HEADER, table), ""]
        lines += [f"Peak memory on top of the avatar: {number(self.memory_mb)} MB.", ""]
        lines += [f"- {mark}" for mark in self.marks]
        return "\n".join(lines).rstrip() + "\n"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "where": self.where.as_dict(),
            "settings": self.settings,
            "marks": list(self.marks),
            "times_ms": asdict(self.times),
            "memory_mb": self.memory_mb,
        }


def write(report: Report, folder: Path) -> None:
    """``speed.md``, ``speed.json`` and ``speed.png``."""
    write_atomically(folder / "speed.md", f"# From skeleton to picture\n\n{report.text()}")
    write_atomically(folder / "speed.json", json.dumps(report.as_dict(), indent=1))
    write_atomically(folder / "speed.png", picture(report))


def picture(report: Report) -> bytes:
    """One bar a stage, with the deciles, as PNG bytes."""
    rows = report.rows[::-1]
    figure = Figure(figsize=(7.2, 0.9 + 0.32 * len(rows)), dpi=120, layout="constrained")
    axes = figure.subplots()
    medians = [max(0.0, s.median) for _, s in rows]
    below = [max(0.0, m - s.p10) for m, (_, s) in zip(medians, rows, strict=True)]
    above = [max(0.0, s.p90 - m) for m, (_, s) in zip(medians, rows, strict=True)]
    axes.barh(
        [name for name, _ in rows], medians, xerr=[below, above], color=BAR, height=0.66,
        error_kw={"ecolor": WHISKER, "lw": 1, "capsize": 2},
    )  # fmt: skip
    for i, (value, more) in enumerate(zip(medians, above, strict=True)):
        axes.annotate(
            number(value), (value + more, i), (4, 0), textcoords="offset points", va="center",
            fontsize=8,
        )  # fmt: skip
    total = report.times.total
    axes.set_title(
        f"{report.settings['avatar']}, {report.settings['picture']}: "
        f"{number(total.median)} ms end to end",
        fontsize=10,
        loc="left",
    )
    axes.set_xlabel("milliseconds, each stage by itself; whiskers from the 1st to the 9th decile")
    axes.margins(x=0.12)
    axes.spines[["top", "right"]].set_visible(False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": ""})
    return stream.getvalue()
