"""Pictures of the raster bench, as PNG bytes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from gsgan.bench.raster_cell import Row
from gsgan.bench.raster_marks import TIMES, growth
from gsgan.utils.palette import BLUE, DASHES, GREEN, GREY, MARKERS, PURPLE, VERMILLION

# One colour a backend in every picture.
COLOURS = {"native": BLUE, "torch": VERMILLION, "gsplat": GREEN, "dense": GREY}


def error_picture(rows: Sequence[Row]) -> bytes:
    """Time against error, one line per backend and channels through its accuracy settings.

    Left: forward time and the largest value error; right: forward + backward time and the worst
    gradient error. Rows without errors, or without any error, are left out.
    """
    figure, (left, right) = _figure()
    settings = list(dict.fromkeys(row.setting for row in rows if row.value_max is not None))
    marks = {setting: MARKERS[i % len(MARKERS)] for i, setting in enumerate(settings)}
    for axes, time, error in ((left, "forward_ms", "value_max"), (right, "both_ms", "gradient")):
        for (backend, channels), line in _by_backend(rows, time, error).items():
            style = _style(rows, backend, channels)
            axes.plot([x for x, _, _ in line], [y for _, y, _ in line], **style)
            for x, y, setting in line:
                axes.plot([x], [y], marks[setting], color=style["color"], markersize=7)
        _label(axes, f"{TIMES[time]}, ms")
        _plain_ticks(axes.xaxis)
    left.set_ylabel("largest error of a value")
    right.set_ylabel("relative error of the worst gradient")
    shown = [Line2D([], [], color="black", ls="", marker=marks[name]) for name in settings]
    right.legend(shown, settings, fontsize=8, frameon=False)
    return _png(figure, left)


def growth_picture(rows: Sequence[Row], reference: dict[str, int]) -> bytes:
    """Forward + backward time at ``standard`` against Gaussians and against pixels."""
    figure, panels = _figure()
    for axes, axis in zip(panels, ("gaussians", "size"), strict=True):
        curves = {
            key: curve
            for key, curve in sorted(growth(rows, reference, axis, "both_ms").items())
            if key[1] == "standard"
        }
        for (backend, _, channels), (x, y) in curves.items():
            axes.plot(x, y, marker="o", markersize=4, **_style(rows, backend, channels))
        other = f"N = {reference['gaussians']}" if axis == "size" else f"{reference['size']}²"
        _label(axes, f"{'pixels' if axis == 'size' else 'Gaussians'} ({other})")
        ticks = sorted({x for xs, _ in curves.values() for x in xs})
        names = [f"{x**0.5:.0f}²" if axis == "size" else f"{x:g}" for x in ticks]
        axes.set_xticks(ticks, names)
        axes.xaxis.set_minor_formatter(NullFormatter())
        _plain_ticks(axes.yaxis)
        _linear_guide(axes, list(curves.values()))
    panels[0].set_ylabel("forward + backward, ms (standard)")
    return _png(figure, panels[0])


def _by_backend(
    rows: Sequence[Row], time: str, error: str
) -> dict[tuple[str, int], list[tuple[float, float, str]]]:
    """(time, error, setting) of each backend and channels, from the largest error down."""
    found: dict[tuple[str, int], list[tuple[float, float, str]]] = {}
    for row in rows:
        x, y = getattr(row, time), getattr(row, error)
        if x is not None and y:  # zero has no place on a logarithmic axis
            found.setdefault((row.backend, row.channels), []).append((x, y, row.setting))
    return {k: sorted(line, key=lambda at: -at[1]) for k, line in sorted(found.items())}


def _style(rows: Sequence[Row], backend: str, channels: int) -> dict[str, Any]:
    order = sorted({row.channels for row in rows})
    return {
        "color": COLOURS.get(backend, PURPLE),
        "linestyle": DASHES[order.index(channels) % len(DASHES)],
        "label": f"{backend}, C={channels}",
    }


def _figure() -> tuple[Figure, Any]:
    figure = Figure(figsize=(10.4, 4.2), dpi=120, layout="constrained")
    return figure, figure.subplots(1, 2)


def _plain_ticks(axis: Axis) -> None:
    """1, 2, 5, 10 in place of powers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _label(axes: Axes, x: str) -> None:
    axes.set_xlabel(x)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(visible=True, which="major", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)


def _linear_guide(axes: Axes, curves: list[tuple[list[float], list[float]]]) -> None:
    """A thin line of slope 1 below the curves: what grows linearly runs beside it."""
    if not curves:
        return
    xs, ys = ([value for curve in curves for value in curve[i]] for i in range(2))
    low, high, floor = min(xs), max(xs), min(ys) / 2
    axes.plot([low, high], [floor, floor * high / low], color="#999999", lw=1, label="linear")


def _png(figure: Figure, legend: Axes) -> bytes:
    if legend.get_lines():
        legend.legend(fontsize=8, frameon=False)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": ""})
    return stream.getvalue()
