"""A sweep over settings as curves: a panel a score, a line a model, the settings along it."""

from __future__ import annotations

import io
import math
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from gsgan.report.grid import Grid, Report, Row
from gsgan.utils.palette import COLOURS, MARKERS

COLUMNS = 3
PANEL = (3.1, 2.4)  # inches
LETTERS = 45  # of all labels along a panel, side by side: more are written aslant
SLANT = 0.7  # inches that takes


def picture(report: Report) -> bytes | None:
    """PNG of every grid of scores: means, spreads as bars. None where no run has a score to show.

    Differences have no panel, nor has a score that no run has.
    """
    grids = [grid for grid in report.grids if any(row.kind == "floor" for row in grid.rows)]
    shown = {id(grid): _columns(grid) for grid in grids}
    grids = [grid for grid in grids if shown[id(grid)]]
    if not grids:
        return None
    down = [math.ceil(len(shown[id(grid)]) / COLUMNS) for grid in grids]
    across = max(min(len(shown[id(grid)]), COLUMNS) for grid in grids)
    high = [PANEL[1] + SLANT * _aslant(_settings(_runs(grid))) for grid in grids]
    size = (PANEL[0] * across, sum(h * n + 0.5 for h, n in zip(high, down, strict=True)))
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    ratios = [h * n for h, n in zip(high, down, strict=True)]
    parts = figure.subfigures(len(grids), 1, height_ratios=ratios, squeeze=False)[:, 0]
    for part, grid, rows in zip(parts, grids, down, strict=True):
        _draw(part, grid, shown[id(grid)], rows, across)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": ""})
    return stream.getvalue()


def _columns(grid: Grid) -> list[int]:
    """Those that some run has a value for."""
    rows = _runs(grid)
    return [i for i in range(len(grid.columns)) if any(_mean(row, i) is not None for row in rows)]


def _draw(part: SubFigure, grid: Grid, columns: list[int], down: int, across: int) -> None:
    axes = [part.add_subplot(down, across, place + 1) for place in range(len(columns))]
    for panel, i in zip(axes, columns, strict=True):
        _panel(panel, grid, i)
    lines, labels = axes[0].get_legend_handles_labels()
    if len(labels) > 1:
        part.legend(lines, labels, loc="outside lower center", ncols=3, fontsize=7, frameon=False)
    part.suptitle(grid.title, fontsize=9)


def _panel(axes: Axes, grid: Grid, i: int) -> None:
    rows = _runs(grid)
    settings = _settings(rows)
    for k, line in enumerate(dict.fromkeys(_split(row)[0] for row in rows)):
        there = [row for row in rows if _split(row)[0] == line and _mean(row, i) is not None]
        if not there:
            continue
        axes.errorbar(
            [settings.index(_split(row)[1]) for row in there],
            [_mean(row, i) for row in there],  # type: ignore[arg-type]
            yerr=[row.cells[i].numbers.get("spread") or 0.0 for row in there],
            color=COLOURS[k % len(COLOURS)],
            marker=MARKERS[k % len(MARKERS)],
            markersize=4,
            lw=1.2,
            capsize=3,
            label=line,
        )
    aslant: dict[str, Any] = {"rotation": 40, "ha": "right", "rotation_mode": "anchor"}
    axes.set_xticks(
        range(len(settings)),
        [s.replace(", ", "\n") for s in settings],
        fontsize=6.5,
        **(aslant if _aslant(settings) else {}),
    )
    axes.set_xlim(-0.4, len(settings) - 0.6)
    axes.set_title(grid.columns[i], fontsize=8.5)
    axes.tick_params(axis="y", labelsize=7)
    axes.grid(visible=True, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _settings(rows: list[Row]) -> list[str]:
    return list(dict.fromkeys(_split(row)[1] for row in rows))


def _aslant(settings: list[str]) -> bool:
    """Whether labels side by side would run into each other."""
    return sum(max(len(part) for part in s.split(", ")) for s in settings) > LETTERS


def _runs(grid: Grid) -> list[Row]:
    return [row for row in grid.rows if row.kind == "run"]


def _split(row: Row) -> tuple[str, str]:
    """The line a row belongs to, and its place on it: ``by_settings`` names rows so."""
    named, colon, variant = row.label.partition(": ")
    model, _, setting = named.partition(", ")
    return f"{model}{colon}{variant}", setting


def _mean(row: Row, i: int) -> float | None:
    mean = row.cells[i].numbers.get("mean")
    return None if mean is None else float(mean)
