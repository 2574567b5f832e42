"""A sweep over settings as curves: a panel per metric, a line per model, the settings along it."""

from __future__ import annotations

import io
import math

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gsgan.report.write import Grid, Report, Row
from gsgan.utils.palette import COLOURS, MARKERS

COLUMNS = 3
PANEL = (3.1, 3.0)  # inches


def curves(report: Report) -> bytes | None:
    """PNG of every grid of scores: means, spreads as bars; None where no run has a score."""
    grids = [grid for grid in report.grids if any(row.kind == "floor" for row in grid.rows)]
    panels = [(grid, i) for grid in grids for i in range(len(grid.columns)) if _shown(grid, i)]
    if not panels:
        return None
    across = min(len(panels), COLUMNS)
    down = math.ceil(len(panels) / across)
    figure = Figure((PANEL[0] * across, PANEL[1] * down + 0.5), dpi=120, layout="constrained")
    for place, (grid, i) in enumerate(panels):
        axes = figure.add_subplot(down, across, place + 1)
        _panel(axes, _shown(grid, i), i)
        axes.set_title(f"{grid.title}\n{grid.columns[i]}", fontsize=8)
    lines, labels = figure.axes[0].get_legend_handles_labels()
    if len(labels) > 1:
        figure.legend(lines, labels, loc="outside lower center", ncols=3, fontsize=7)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": ""})
    return stream.getvalue()


def _shown(grid: Grid, i: int) -> list[Row]:
    """The rows of runs that have a value in column i."""
    return [row for row in grid.rows if row.kind == "run" and "mean" in row.cells[i].numbers]


def _panel(axes: Axes, rows: list[Row], i: int) -> None:
    settings = list(dict.fromkeys(_split(row)[1] for row in rows))
    for k, line in enumerate(dict.fromkeys(_split(row)[0] for row in rows)):
        own = [row for row in rows if _split(row)[0] == line]
        axes.errorbar(
            [settings.index(_split(row)[1]) for row in own],
            [row.cells[i].numbers["mean"] for row in own],
            yerr=[row.cells[i].numbers["spread"] or 0.0 for row in own],
            color=COLOURS[k % len(COLOURS)],
            marker=MARKERS[k % len(MARKERS)],
            markersize=4,
            lw=1.2,
            capsize=3,
            label=line,
        )
    names = [setting.replace(", ", "\n") for setting in settings]
    axes.set_xticks(range(len(names)), names, fontsize=6.5, rotation=40, ha="right")
    axes.tick_params(axis="y", labelsize=7)
    axes.grid(visible=True, alpha=0.25)


def _split(row: Row) -> tuple[str, str]:
    """The line that a row belongs to and its place along it, of a name by `by_settings`."""
    named, colon, variant = row.label.partition(": ")
    model, _, setting = named.partition(", ")
    return f"{model}{colon}{variant}", setting
