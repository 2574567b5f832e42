"""What the trade-off bench found: rows, the front, and the text that people read."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from gsgan.bench.environment import Environment
from gsgan.bench.speed_stages import Spread
from gsgan.bench.tables import NOTHING, markdown, number
from gsgan.bench.trade_off_front import front
from gsgan.bench.trade_off_points import Point, by_label
from gsgan.train.curve import Curve

# Metric: heading, digits, and 1 where more is better, -1 where less is.
QUALITIES = {
    "psnr": ("PSNR dB", 2, 1),
    "ssim": ("SSIM", 4, 1),
    "edge_f1": ("edge F1", 3, 1),
    "lpips": ("LPIPS", 4, -1),
}


@dataclass(frozen=True)
class Row:
    """One point, the mean over its seeds.

    Args:
        factor, label: what is changed from the base point, and to what.
        psnr, ssim, edge_f1, lpips: on the held-out pictures; None where they cannot be had.
        left_out: pictures without a finite score, of any metric.
        ms, p10, p90: milliseconds a frame, median and deciles.
        memory_mb: peak of painting, on top of the avatar.
        seconds: that its training took; None where the logs do not say.
        seeds: runs in the mean.
    """

    factor: str
    label: str
    psnr: float | None
    ssim: float | None
    edge_f1: float | None
    lpips: float | None
    left_out: int
    ms: float
    p10: float
    p90: float
    memory_mb: float | None
    seconds: float | None
    seeds: int

    def better(self, metric: str) -> float | None:
        """The metric, turned so that more is better."""
        value: float | None = getattr(self, metric)
        return None if value is None else QUALITIES[metric][2] * value


def make_rows(
    points: Sequence[Point],
    found: Sequence[Mapping[str, Any]],
    samples: Sequence[Sequence[float]],
    seconds: Mapping[Path, float | None],
) -> list[Row]:
    """One row a factor and label, in the points' order.

    Args:
        points: measured.
        found: quality and memory of each.
        samples: milliseconds of each.
        seconds: of training, by run folder.
    """
    rows = []
    for (factor, label), group in by_label(points).items():
        spread = Spread.of([ms for i in group for ms in samples[i]])
        memory = [m for i in group if (m := found[i]["memory_mb"]) is not None]
        left_out = sum(
            n for i in group for name, n in found[i].items() if name.endswith("_left_out")
        )
        rows.append(
            Row(
                factor=factor,
                label=label,
                **{metric: _mean([found[i].get(metric) for i in group]) for metric in QUALITIES},
                left_out=left_out,
                ms=spread.median,
                p10=spread.p10,
                p90=spread.p90,
                memory_mb=max(memory, default=None),
                seconds=_mean([seconds.get(points[i].folder) for i in group]),
                seeds=len(group),
            )
        )
    return rows


def _mean(values: Sequence[float | None]) -> float | None:
    there = [value for value in values if value is not None]
    return statistics.fmean(there) if there and len(there) == len(values) else None


@dataclass(frozen=True)
class Report:
    """Everything that one run found.

    Args:
        rows: of all points.
        curves: held-out PSNR against training time.
        quality, second: the metrics that are drawn; the front is about the first.
        pictures: how many were scored.
        split: of the data.
        subject: name of the avatar whose settings were changed.
        where: the machine.
        marks: notes that the table must carry.
    """

    rows: Sequence[Row]
    curves: Sequence[Curve]
    quality: str
    second: str
    pictures: int
    split: str
    subject: str
    where: Environment
    marks: Sequence[str]

    def front(self, metric: str) -> list[int]:
        """Indices of the rows that none beats in time and this metric."""
        scored = [i for i, row in enumerate(self.rows) if row.better(metric) is not None]
        better = [self.rows[i].better(metric) or 0.0 for i in scored]
        return [scored[k] for k in front([self.rows[i].ms for i in scored], better)]

    def table(self) -> str:
        """The rows in Markdown."""
        metrics = [m for m in QUALITIES if any(getattr(row, m) is not None for row in self.rows)]
        ahead = set(self.front(self.quality))
        header = ["changed", "to", *(QUALITIES[m][0] for m in metrics)]
        header += ["ms a frame", "10–90 %", "peak MB", "training min", "front"]
        lines = []
        for i, row in enumerate(self.rows):
            scores = [_digits(getattr(row, m), QUALITIES[m][1]) for m in metrics]
            seeds = f" ({row.seeds} seeds)" if row.seeds > 1 else ""
            between = f"{number(row.p10)}–{number(row.p90)}"
            minutes = None if row.seconds is None else row.seconds / 60
            lines.append(
                [
                    *(row.factor, row.label + seeds, *scores, number(row.ms), between),
                    *(number(row.memory_mb), number(minutes), "yes" if i in ahead else ""),
                ]
            )
        return markdown(header, lines)

    def text(self) -> str:
        """The block of the page, less its pictures."""
        notes = list(self.marks)
        if all(row.lpips is None for row in self.rows):
            notes.append("LPIPS n/a: the backbone's weights are not at hand")
        if left := sum(row.left_out for row in self.rows):
            notes.append(f"{left} scores were not finite and are not in the means")
        if not self.curves:
            notes.append("no training times: the runs' logs hold none (val/seconds)")
        about = (
            f"{self.pictures} pictures of {self.split}; settings changed on {self.subject}; one "
            f"picture at a time. Front: nothing is as fast and scores as much "
            f"({QUALITIES[self.quality][0]})."
        )
        listed = "".join(f"\n- {note}" for note in notes)
        return f"{self.where.sentence()}.\n\n{about}\n\n{self.table()}\n{listed}\n"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "where": self.where.as_dict(),
            "split": self.split,
            "pictures": self.pictures,
            "subject": self.subject,
            "marks": list(self.marks),
            "rows": [asdict(row) for row in self.rows],
            "front": [self.rows[i].label for i in self.front(self.quality)],
            "curves": [asdict(curve) for curve in self.curves],
        }


def _digits(value: float | None, digits: int) -> str:
    return NOTHING if value is None else f"{value:.{digits}f}"
