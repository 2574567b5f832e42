"""A sweep over settings as curves: a panel per metric, a line per model, the settings along it."""

from __future__ import annotations

import io
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gsgan.report.write import Report, Row
from gsgan.utils.palette import COLOURS, MARKERS

COLUMNS = 3
PANEL = (3.1, 3.0)  # inches


def curves(report: Report) -> bytes | None:
    """PNG of every grid of scores: means, spreads as bars; None where no run has a score."""
    panels = []
    for grid in report.grids:
        for i, column in enumerate(grid.columns):
            rows = [r for r in grid.rows if r.kind == "run" and r.cells[i].mean is not None]
            panels += [(f"{grid.title}\n{column}", rows, i)] if rows else []
    if not panels:
        return None
    across, down = min(len(panels), COLUMNS), -(-len(panels) // COLUMNS)
    figure = Figure((PANEL[0] * across, PANEL[1] * down + 0.5), dpi=120, layout="constrained")
    for place, (title, rows, i) in enumerate(panels, start=1):
        axes = figure.add_subplot(down, across, place)
        axes.set_title(title, fontsize=8)
        _draw(axes, rows, i)
    lines, labels = figure.axes[0].get_legend_handles_labels()
    if len(labels) > 1:
        figure.legend(lines, labels, loc="outside lower center", ncols=3, fontsize=7)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": ""})
    return stream.getvalue()


def _draw(axes: Axes, rows: list[Row], i: int) -> None:
    """Column i of rows, a line per model, the settings of `by_settings` along it."""
    lines: dict[str, list[tuple[str, Row]]] = {}
    for row in rows:
        named, colon, variant = row.label.partition(": ")
        model, _, setting = named.partition(", ")
        lines.setdefault(f"{model}{colon}{variant}", []).append((setting, row))
    settings = list(dict.fromkeys(setting for line in lines.values() for setting, _ in line))
    for k, (name, line) in enumerate(lines.items()):
        at = [settings.index(setting) for setting, _ in line]
        spread = [row.cells[i].spread or 0.0 for _, row in line]
        means: list[Any] = [row.cells[i].mean for _, row in line]
        marker, colour = MARKERS[k % len(MARKERS)], COLOURS[k % len(COLOURS)]
        look: dict[str, Any] = {"marker": marker, "color": colour, "ms": 4, "lw": 1.2, "capsize": 3}
        axes.errorbar(at, means, yerr=spread, label=name, **look)
    names = [setting.replace(", ", "\n") for setting in settings]
    axes.set_xticks(range(len(names)), names, fontsize=6.5, rotation=40, ha="right")
    axes.tick_params(axis="y", labelsize=7)
    axes.grid(visible=True, alpha=0.25)
