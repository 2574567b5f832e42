"""A sweep over settings as curves: a panel a score, the table's rows along it."""

from __future__ import annotations

import io
import math

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gsgan.reporting.grid import Grid, Report, Row

COLUMNS = 3
PANEL = (3.1, 2.5)  # inches
COLOUR = "#0072b2"


def picture(report: Report) -> bytes:
    """PNG of the last split's scores: means, spreads as bars; differences are not shown.

    A score that no run has gets no panel.
    """
    scored = [grid for grid in report.grids if any(row.kind == "floor" for row in grid.rows)]
    grid = scored[-1]
    rows = [row for row in grid.rows if row.kind == "run"]
    shown = [i for i in range(len(grid.columns)) if any(_mean(row, i) is not None for row in rows)]
    down = math.ceil(len(shown) / COLUMNS)
    across = min(len(shown), COLUMNS)
    size = (PANEL[0] * across, PANEL[1] * down + 0.4)
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    for place, i in enumerate(shown):
        _panel(figure.add_subplot(down, across, place + 1), grid, rows, i)
    figure.suptitle(grid.title, fontsize=9)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": ""})
    return stream.getvalue()


def _panel(axes: Axes, grid: Grid, rows: list[Row], i: int) -> None:
    there = [(x, row) for x, row in enumerate(rows) if _mean(row, i) is not None]
    spreads = [row.cells[i].numbers.get("spread") or 0.0 for _, row in there]
    axes.errorbar(
        [x for x, _ in there],
        [_mean(row, i) for _, row in there],  # type: ignore[arg-type]
        yerr=spreads,
        color=COLOUR,
        marker="o",
        markersize=4,
        lw=1.2,
        capsize=3,
    )
    labels = [row.label.replace(", ", "\n") for row in rows]
    axes.set_xticks(range(len(rows)), labels, fontsize=6.5)
    axes.set_xlim(-0.4, len(rows) - 0.6)
    axes.set_title(grid.columns[i], fontsize=8.5)
    axes.tick_params(axis="y", labelsize=7)
    axes.grid(visible=True, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _mean(row: Row, i: int) -> float | None:
    mean = row.cells[i].numbers.get("mean")
    return None if mean is None else float(mean)
