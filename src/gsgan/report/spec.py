"""What a table shows: scores, rows, splits, as ``conf/table`` says it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gsgan.utils.errors import ConfigError

PAINTED, SPLAT, FLOOR = "full", "splat", "floor"  # variants in metrics.json
NEEDED = ("name", "title")
MINUS = "−"


@dataclass(frozen=True)
class Metric:
    """How one score is shown.

    Args:
        heading: of its column.
        digits: after the point.
        better: ``↑`` the higher, ``↓`` the lower, ``→1`` the nearer to one.
    """

    heading: str
    digits: int
    better: str


METRICS = {
    "psnr": Metric("PSNR dB", 2, "↑"),
    "psnr_person": Metric("PSNR dB in box", 2, "↑"),
    "ssim": Metric("SSIM", 4, "↑"),
    "ssim_person": Metric("SSIM in box", 4, "↑"),
    "lpips": Metric("LPIPS", 4, "↓"),
    "lpips_person": Metric("LPIPS in box", 4, "↓"),
    "edge_f1": Metric("edge F1", 3, "↑"),
    "edge_f1_person": Metric("edge F1 in box", 3, "↑"),
    "edge_ratio": Metric("edges", 3, "→1"),
    "edge_ratio_person": Metric("edges in box", 3, "→1"),
    "high_frequencies": Metric("detail", 3, "→1"),
    "miou": Metric("mIoU", 4, "↑"),
    "miou_with_background": Metric("mIoU with background", 4, "↑"),
}


def heading(metric: str) -> str:
    """A column's heading with the direction that is better."""
    return f"{METRICS[metric].heading} {METRICS[metric].better}"


def shown(metric: str, value: float, *, signed: bool = False) -> str:
    """A value with the metric's digits, and a real minus; never a minus before zero."""
    text = f"{value:{'+' if signed else ''}.{METRICS[metric].digits}f}"
    if float(text) == 0:
        text = text.lstrip("+-")
    return text.replace("-", MINUS)


@dataclass(frozen=True)
class RowSpec:
    """One row: a model's (or method's) runs, one of their pictures.

    Args:
        label: what the row is called; None takes the name.
        run: name of the model or method.
        variant: ``full`` for the final picture, ``splat`` for Step I's colour.
    """

    run: str
    label: str | None = None
    variant: str = PAINTED

    @property
    def title(self) -> str:
        """What stands in the row's first column."""
        return self.run if self.label is None else self.label


@dataclass(frozen=True)
class TableSpec:
    """One table.

    Args:
        name: of the table, its files' titles and its block in a page.
        title: its heading.
        metrics: columns, or one grid each where subjects are the columns.
        splits: one grid each.
        rows: in this order, each even where it has no run yet; None takes whatever there is.
        by: dotted keys of the runs' configs whose values make rows of their own, so that a sweep
            over settings can be shown.
        variants: pictures that make rows, where ``rows`` is None.
        subjects: columns, where each subject has its own; None for metrics as columns.
        data: the data set that it is about; None takes any one.
        apart: one set of grids for each data set and protocol, in place of a refusal.
        reference: the row that others are compared with, seed by seed; None compares nothing.
        paper: the entry in paper.yaml that goes with it, or None.

    Raises:
        ConfigError: on a metric that there is not, or a value that does not fit.
    """

    name: str
    title: str
    metrics: Sequence[str]
    splits: Sequence[str]
    rows: Sequence[RowSpec | Mapping[str, Any]] | None = None
    by: Sequence[str] | None = None
    variants: Sequence[str] = (PAINTED,)
    subjects: Sequence[str] | None = None
    data: str | None = None
    apart: bool = False
    reference: str | None = None
    paper: str | None = None

    def __post_init__(self) -> None:
        for name in ("name", "title", "data", "reference", "paper"):
            held = getattr(self, name)
            if not (isinstance(held, str) and held) and (held is not None or name in NEEDED):
                raise ConfigError(f"table.{name} must be a text, got {held!r}")
        if not isinstance(self.apart, bool):
            raise ConfigError(f"table.apart must be true or false, got {self.apart!r}")
        for name in ("metrics", "splits", "variants", "subjects", "rows", "by"):
            self._check_list(name, getattr(self, name))
        unknown = [metric for metric in self.metrics if metric not in METRICS]
        if unknown:
            raise ConfigError(
                f"table.metrics has {', '.join(map(str, unknown))}; known: {', '.join(METRICS)}"
            )
        if wrong := set(self.variants) - {PAINTED, SPLAT}:
            raise ConfigError(
                f"table.variants must be among full and splat, got {', '.join(map(str, wrong))}"
            )
        if self.rows is not None:
            rows = [r if isinstance(r, RowSpec) else _row(r) for r in self.rows]
            object.__setattr__(self, "rows", rows)
        if self.by is not None and self.rows is not None:
            raise ConfigError("table.by makes rows of its own, so table.rows must be null")
        if self.subjects is not None:
            object.__setattr__(self, "subjects", [str(s) for s in self.subjects])

    def _check_list(self, name: str, held: Any) -> None:
        if held is None and name in ("subjects", "rows", "by"):
            return
        if isinstance(held, str) or not isinstance(held, Sequence) or not held:
            raise ConfigError(f"table.{name} must be a list of at least one, got {held!r}")
        if name != "rows" and not all(isinstance(entry, str | int) for entry in held):
            raise ConfigError(f"table.{name} must be a list of names, got {list(held)}")
        if twice := [entry for i, entry in enumerate(held) if entry in held[:i]]:
            raise ConfigError(f"table.{name} has {twice[0]} twice")

    def row_specs(self, names: Sequence[str]) -> list[RowSpec]:
        """The table's rows.

        Args:
            names: of the runs there are, for a table that takes whatever there is.
        """
        if self.rows is not None:
            return [row for row in self.rows if isinstance(row, RowSpec)]
        ordered = sorted(names, key=lambda name: (name != self.reference, _natural(name)))
        return [
            RowSpec(name, f"{name}: Step I's colour" if variant == SPLAT else None, variant)
            for name in ordered
            for variant in self.variants
        ]


def _natural(name: str) -> list[str | float]:
    """Numbers in a name by their size, words between them by letters."""
    parts = re.split(r"((?<= )-?\d+(?:\.\d+)?(?:e[+-]?\d+)?)", name)
    return [float(part) if i % 2 else part for i, part in enumerate(parts)]


def _row(given: Mapping[str, Any]) -> RowSpec:
    try:
        row = RowSpec(**given)
    except TypeError:
        raise ConfigError(
            f"table.rows must be like {{run: wo_seg, label: w/o S, variant: full}}, got {given!r}"
        ) from None
    if not isinstance(row.run, str) or not isinstance(row.label, str | None):
        raise ConfigError(f"table.rows: run and label must be texts, got {given!r}")
    if row.variant not in (PAINTED, SPLAT):
        raise ConfigError(f"table.rows: variant must be full or splat, got {row.variant!r}")
    return row


def subject_of(root: str | None, subjects: Sequence[str]) -> str | None:
    """The subject whose folder this is: ``CoreView_377`` and ``my_377`` are both 377's."""
    if root is None:
        return None
    return next((s for s in subjects if root == s or root.endswith(f"_{s}")), None)
