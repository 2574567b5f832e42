"""The content of a table, as set in ``conf/table``."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gsgan.data.splits import SPLITS
from gsgan.metrics.names import METRICS
from gsgan.utils.checks import one_of
from gsgan.utils.errors import ConfigError

# variants in metrics.json
PAINTED = "full"
SPLAT = "splat"
FLOOR = "floor"
MEAN = "mean"  # the column over subjects


def written(metric: str, value: float, *, times_1000: bool = False) -> str:
    """A value with the metric's digits and a typographic minus; zero has no sign.

    A value that was multiplied by 1000 has two digits fewer.
    """
    digits = METRICS[metric].digits - (2 if times_1000 else 0)
    text = f"{value:.{digits}f}"
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
    times_1000: Sequence[str] = ()

    def __post_init__(self) -> None:
        rows: Any = self.rows
        if rows is not None:
            object.__setattr__(self, "rows", [RowSpec(**row) for row in rows])
        if self.subjects is not None:
            object.__setattr__(
                self, "subjects", [str(subject) for subject in self.subjects]
            )
        if self.by and rows is not None:
            raise ConfigError(
                "table.by makes rows of its own, so table.rows must be null"
            )
        variants = [*self.variants, *(row.variant for row in self.rows or ())]
        for key, known, values in (
            ("metrics", METRICS, self.metrics),
            ("splits", SPLITS, self.splits),
            ("variants", (PAINTED, SPLAT), variants),
            ("times_1000", METRICS, self.times_1000),
        ):
            if not values and key != "times_1000":
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
