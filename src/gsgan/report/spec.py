"""The content of a table, as set in ``conf/table``."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from gsgan.data.splits import SPLITS
from gsgan.metrics.names import FULL, METRICS, SPLAT
from gsgan.utils.checks import one_of
from gsgan.utils.errors import ConfigError

MEAN = "mean"  # the column over subjects


def format_value(metric: str, value: float, *, times_1000: bool = False) -> str:
    """A value with the metric's digits and a typographic minus; zero has no sign.

    A value that was multiplied by 1000 has two digits fewer.
    """
    digits = METRICS[metric].digits
    if times_1000:
        digits -= 2

    # A rounded value of -0.00 is printed without its sign.
    text = f"{value:.{digits}f}"
    return text.lstrip("-") if float(text) == 0 else text.replace("-", "−")


@dataclass(frozen=True)
class RowSpec:
    """One row of a table."""

    run: str  # name of a model or method
    label: str | None = None  # None: the name
    variant: str = FULL  # the final image, or ``splat``: Step I's colour


@dataclass(frozen=True)
class TableSpec:
    """One table; `conf/table/plain.yaml` explains the keys.

    Raises:
        ConfigError: on an unknown metric, split or variant, or if a list is empty that must not be.
    """

    name: str
    title: str
    metrics: Sequence[str]
    splits: Sequence[str]  # one grid each
    rows: Sequence[RowSpec] | None = None  # None: a row per name
    # settings whose values have rows of their own
    by: Sequence[str] | None = None
    variants: Sequence[str] = (FULL,)
    subjects: Sequence[str] | None = None  # columns, with a grid per metric
    data: str | None = None  # the only data set of the runs
    paper: str | None = None  # a table of paper.yaml
    times_1000: Sequence[str] = ()  # metrics that are printed times 1000

    def __post_init__(self) -> None:
        # Rows come as mappings, and subjects may be numbers.
        variants = list(self.variants)
        rows: Any = self.rows
        if rows is not None:
            if self.by:
                raise ConfigError(
                    "table.by makes rows of its own, so table.rows must be null"
                )
            rows = [RowSpec(**row) for row in rows]
            variants += [row.variant for row in rows]
            object.__setattr__(self, "rows", rows)
        if self.subjects is not None:
            object.__setattr__(self, "subjects", list(map(str, self.subjects)))

        # Each list has known values only, and all but one list must have some.
        for key, allowed, values in (
            ("metrics", METRICS, self.metrics),
            ("splits", SPLITS, self.splits),
            ("variants", (FULL, SPLAT), variants),
            ("times_1000", METRICS, self.times_1000),
        ):
            if not values and key != "times_1000":
                raise ConfigError(f"table.{key} must be a list of at least one")
            for value in values:
                one_of(f"table.{key}", value, allowed)
