"""What a table shows, as set in ``conf/table``, and how each metric is written."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from gsgan.data.splits import SPLITS
from gsgan.utils.checks import one_of
from gsgan.utils.errors import ConfigError

PAINTED, SPLAT, FLOOR = "full", "splat", "floor"  # variants in metrics.json
MEAN = "mean"  # the column over subjects
IN_BOXES = ("psnr_hands", "ssim_hands", "psnr_mouth", "ssim_mouth")


class Metric(NamedTuple):
    """A metric's heading, digits after the point, and better: ``↑``, ``↓`` or ``→1`` (near 1)."""

    heading: str
    digits: int
    better: str


METRICS = {
    "psnr": Metric("PSNR dB", 2, "↑"),
    "psnr_person": Metric("PSNR dB in box", 2, "↑"),
    "psnr_inside": Metric("PSNR dB in box off the outline", 2, "↑"),
    "ssim": Metric("SSIM", 4, "↑"),
    "ssim_person": Metric("SSIM in box", 4, "↑"),
    "lpips": Metric("LPIPS", 4, "↓"),
    "lpips_person": Metric("LPIPS in box", 4, "↓"),
    "edge_f1": Metric("edge F1", 3, "↑"),
    "edge_f1_person": Metric("edge F1 in box", 3, "↑"),
    "edge_ratio": Metric("edges", 3, "→1"),
    "edge_ratio_person": Metric("edges in box", 3, "→1"),
    "high_frequencies": Metric("detail", 3, "→1"),
    "psnr_hands": Metric("PSNR dB hands", 2, "↑"),
    "ssim_hands": Metric("SSIM hands", 4, "↑"),
    "psnr_mouth": Metric("PSNR dB mouth", 2, "↑"),
    "ssim_mouth": Metric("SSIM mouth", 4, "↑"),
    "miou": Metric("mIoU", 4, "↑"),
    "miou_with_background": Metric("mIoU with background", 4, "↑"),
}


def heading(metric: str) -> str:
    """A column's heading with the direction that is better."""
    return f"{METRICS[metric].heading} {METRICS[metric].better}"


def written(metric: str, value: float) -> str:
    """A value with the metric's digits and a typographic minus; zero has no sign."""
    text = f"{value:.{METRICS[metric].digits}f}"
    return text.lstrip("-") if float(text) == 0 else text.replace("-", "−")


@dataclass(frozen=True)
class RowSpec:
    """One row: the runs of a model or method, its label (None: the name), and ``full`` for the
    final image or ``splat`` for Step I's colour."""

    run: str
    label: str | None = None
    variant: str = PAINTED


@dataclass(frozen=True)
class TableSpec:
    """One table; `conf/table/plain.yaml` explains the keys.

    Raises:
        ConfigError: on an unknown metric, split or variant, or where a list must not be empty.
    """

    name: str
    title: str
    metrics: Sequence[str]
    splits: Sequence[str]
    rows: Sequence[RowSpec] | None = None
    by: Sequence[str] | None = None
    variants: Sequence[str] = (PAINTED,)
    subjects: Sequence[str] | None = None
    data: str | None = None
    paper: str | None = None

    def __post_init__(self) -> None:
        rows: Any = self.rows
        if rows is not None:
            object.__setattr__(self, "rows", [RowSpec(**row) for row in rows])
        if self.subjects is not None:
            object.__setattr__(self, "subjects", [str(subject) for subject in self.subjects])
        if self.by and rows is not None:
            raise ConfigError("table.by makes rows of its own, so table.rows must be null")
        variants = [*self.variants, *(row.variant for row in self.rows or ())]
        for key, known, values in (
            ("metrics", METRICS, self.metrics),
            ("splits", SPLITS, self.splits),
            ("variants", (PAINTED, SPLAT), variants),
        ):
            if not values:
                raise ConfigError(f"table.{key} must be a list of at least one")
            for value in values:
                one_of(f"table.{key}", value, known)


def natural(name: str) -> list[str | float]:
    """A sort key: numbers by value, the words between them by letters."""
    parts = re.split(r"((?<= )-?\d+(?:\.\d+)?(?:e[+-]?\d+)?)", name)
    return [float(part) if i % 2 else part for i, part in enumerate(parts)]


def subject_of(root: str | None, subjects: Sequence[str]) -> str | None:
    """The subject of a data folder: ``CoreView_377`` and ``my_377`` are both 377's."""
    name = root or ""
    return next((s for s in subjects if name == s or name.endswith(f"_{s}")), None)
