"""Tables and plots of the raster bench."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

from gsgan.bench.common import NOTHING, markdown, number, panels, plain_ticks, png, sentence
from gsgan.utils.palette import BLUE, DASHES, GREEN, MARKERS, PURPLE, VERMILLION

COLOURS = {"native": BLUE, "torch": VERMILLION, "gsplat": GREEN}  # the same in every plot
GROWTH = "standard"  # the setting of the table and plot over the whole grid
TIMES = {"forward_ms": "forward", "both_ms": "forward + backward"}
# Heading and significant digits of the table's columns of numbers.
NUMBERS = {
    "forward_ms": ("forward ms", 3),
    "both_ms": ("forward + backward ms", 3),
    "value_max": ("largest error", 2),
    "value_mean": ("mean error", 2),
    "bound": ("proven bound", 2),
    "gradient": ("gradient error", 2),
    "worst_group": ("worst group", 0),
    "gradient_max": ("largest gradient error", 2),
    "memory_mb": ("peak MB", 3),
}


def number_table(frame: pd.DataFrame, *, cells: bool = True) -> str:
    """All rows in Markdown, with or without the columns N and size."""
    shown = pd.DataFrame({"C": frame.channels, "backend": frame.backend, "setting": frame.setting})
    if cells:
        shown.insert(0, "N", frame.gaussians)
        shown.insert(2, "size", frame["size"].astype(str) + "²")
    for column, (heading, digits) in NUMBERS.items():
        values = frame.get(column, pd.Series(index=frame.index, dtype=object))
        shown[heading] = [number(v, digits) if digits else _text(v) for v in values]
    return markdown(shown)


def _text(value: Any) -> str:
    return NOTHING if pd.isna(value) else str(value)


def growth_table(frame: pd.DataFrame) -> str:
    """Forward / forward + backward milliseconds of one setting over the whole grid, Markdown."""
    rows = frame[frame.setting == GROWTH].copy()
    rows["size"] = rows["size"].astype(str).str.rjust(6) + "²"  # in order of their numbers
    rows["kind"] = rows.backend + ", C=" + rows.channels.astype(str)
    rows["ms"] = [f"{number(a)} / {number(b)}" for a, b in zip(*map(rows.get, TIMES), strict=True)]
    rows = rows.rename(columns={"gaussians": "N"})
    wide = rows.pivot_table(index=["N", "size"], columns="kind", values="ms", aggfunc="first")
    wide = wide.fillna(NOTHING).reset_index()
    wide["size"] = wide["size"].str.strip()
    return markdown(wide)


def summary(
    frame: pd.DataFrame, here: pd.DataFrame, n: int, size: int, where: Mapping[str, Any]
) -> str:
    """What the docs show: the reference scene, the growth, the plots."""
    return "\n\n".join(
        [
            sentence(where) + ".",
            "![time against error](pictures/raster_error.png)",
            f"{n} Gaussians at {size}²; medians of interleaved runs:",
            number_table(here, cells=False),
            "![time against Gaussians and pixels](pictures/raster_growth.png)",
            f"`{GROWTH}`, milliseconds forward / forward + backward:",
            growth_table(frame),
        ]
    )


def images(frame: pd.DataFrame, n: int, size: int) -> dict[str, bytes]:
    """Both plots as PNG bytes, by file name.

    Args:
        frame: all rows.
        n, size: the reference scene, of the first plot; the second varies one of the two.
    """
    here = frame[(frame.gaussians == n) & (frame["size"] == size)]
    return {
        "raster_error.png": error_plot(here),
        "raster_growth.png": growth_plot(frame, {"gaussians": n, "size": size}),
    }


def error_plot(here: pd.DataFrame) -> bytes:
    """Time against error, one line per backend and channels through its accuracy settings.

    Left: forward time and the largest value error; right: forward + backward time and the worst
    gradient error. Rows without errors, or without any error, are left out.
    """
    figure, (left, right) = panels(2, 10.4, 4.2)
    here = here.reindex(columns=here.columns.union(["value_max", "gradient"]))
    settings = list(here.setting[here.value_max.notna()].unique())
    marks = {name: MARKERS[i % len(MARKERS)] for i, name in enumerate(settings)}
    for axes, time, error in ((left, "forward_ms", "value_max"), (right, "both_ms", "gradient")):
        shown = here[here[error] > 0].sort_values(error, ascending=False)  # the axis has no zero
        for (backend, channels), line in shown.groupby(["backend", "channels"]):
            style = _style(here, backend, channels)
            axes.plot(line[time], line[error], **style)
            for _, row in line.iterrows():
                axes.plot(row[time], row[error], marks[row.setting], color=style["color"], ms=7)
        axes.set(xlabel=f"{TIMES[time]}, ms", xscale="log", yscale="log")
        plain_ticks(axes.xaxis)
    left.set_ylabel("largest error of a value")
    right.set_ylabel("relative error of the worst gradient")
    shapes = [Line2D([], [], color="black", ls="", marker=marks[name]) for name in settings]
    right.legend(shapes, settings, fontsize=8, frameon=False)
    if left.get_lines():
        left.legend(fontsize=8, frameon=False)
    return png(figure)


def growth_plot(frame: pd.DataFrame, reference: dict[str, int]) -> bytes:
    """Forward + backward time at one setting against Gaussians and against pixels."""
    figure, both = panels(2, 10.4, 4.2)
    frame = frame[frame.setting == GROWTH]
    for axes, axis, other in zip(both, ("gaussians", "size"), ("size", "gaussians"), strict=True):
        shown = frame[frame[other] == reference[other]].sort_values(axis)
        power = 2 if axis == "size" else 1
        for (backend, channels), line in shown.groupby(["backend", "channels"]):
            style = _style(frame, backend, channels)
            axes.plot(line[axis] ** power, line.both_ms, marker="o", ms=4, **style)
        name, at = ("pixels", f"N = {reference['gaussians']}") if power == 2 else (
            "Gaussians", f"{reference['size']}²"
        )  # fmt: skip
        axes.set(xlabel=f"{name} ({at})", xscale="log", yscale="log")
        ticks = sorted(shown[axis].unique())
        axes.set_xticks([x**power for x in ticks], [f"{x}²" if power == 2 else x for x in ticks])
        axes.xaxis.set_minor_formatter(NullFormatter())
        plain_ticks(axes.yaxis)
        if len(shown):  # a line of slope 1 below the curves
            low, high = shown[axis].min() ** power, shown[axis].max() ** power
            floor = shown.both_ms.min() / 2
            axes.plot([low, high], [floor, floor * high / low], "#999999", lw=1, label="linear")
            axes.legend(fontsize=8, frameon=False)
    both[0].set_ylabel(f"forward + backward, ms ({GROWTH})")
    return png(figure)


def _style(frame: pd.DataFrame, backend: str, channels: int) -> dict[str, Any]:
    order = sorted(frame.channels.unique())
    return {
        "color": COLOURS.get(backend, PURPLE),
        "linestyle": DASHES[order.index(channels) % len(DASHES)],
        "label": f"{backend}, C={channels}",
    }
