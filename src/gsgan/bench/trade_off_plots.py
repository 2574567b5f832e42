"""Pictures of the trade-off bench, as PNG bytes."""

from __future__ import annotations

import io
import statistics
from collections.abc import Sequence
from dataclasses import replace

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from gsgan.bench.tables import number
from gsgan.bench.trade_off_front import steps
from gsgan.bench.trade_off_labels import put_labels
from gsgan.bench.trade_off_points import BASE
from gsgan.bench.trade_off_report import QUALITIES, Report, Row
from gsgan.train.curve import Curve
from gsgan.utils.palette import BLACK, COLOURS, DASHES, GREY, MARKERS

ORDER = (BLACK, *COLOURS[:-1], GREY)  # the base point's first
STAR = "*"  # the base point's
FAR = 8.0  # times the median time, beyond which a point would squeeze the others together
KNOWN = {
    "base": "Step I and II (full)",
    "full": "Step I and II (full)",
    "splat_only": "Step I only (splat_only)",
    "lbs_splat": "baseline: Gaussians on the body (lbs_splat)",
    "image_to_image": "baseline: UNet on the drawn skeleton (image_to_image)",
}


def trade_off_picture(report: Report) -> bytes:
    """Two metrics against milliseconds a frame, all points labelled, the front as a step line."""
    metrics = [report.quality]
    if report.second != report.quality and any(r.better(report.second) for r in report.rows):
        metrics.append(report.second)
    figure = Figure(figsize=(6.4 * len(metrics), 5.6), dpi=120, layout="constrained")
    panels = figure.subplots(1, len(metrics), squeeze=False)[0]
    styles = _styles(report.rows)
    report = replace(report, rows=within(report.rows))
    for axes, metric in zip(panels, metrics, strict=True):
        _points(axes, report, metric, styles)
    handles, names = panels[0].get_legend_handles_labels()
    handles, names = [*handles[1:], handles[0]], [*names[1:], names[0]]  # the front is not first
    figure.legend(
        handles, names, loc="outside lower center", ncols=min(6, len(names)), fontsize=8.5,
        frameon=False,
    )  # fmt: skip
    for axes, metric in zip(panels, metrics, strict=True):
        rows = [row for row in report.rows if row.better(metric) is not None]
        put_labels(
            axes,
            [row.ms for row in rows],
            [getattr(row, metric) for row in rows],
            [row.label for row in rows],
            [styles[row.factor][0] for row in rows],
        )
    return _png(figure)


def within(rows: Sequence[Row]) -> list[Row]:
    """Rows as drawn: one far slower than the rest stands at the edge and says where it belongs."""
    edge = FAR * statistics.median(row.ms for row in rows)
    return [
        row
        if row.ms <= edge
        else replace(row, ms=edge, p10=edge, p90=edge, label=f"{row.label}: {number(row.ms)} ms →")
        for row in rows
    ]


def _styles(rows: Sequence[Row]) -> dict[str, tuple[str, str]]:
    factors = list(dict.fromkeys(row.factor for row in rows))
    return {
        factor: (ORDER[i % len(ORDER)], STAR if factor == BASE else MARKERS[i % len(MARKERS)])
        for i, factor in enumerate(factors)
    }


def _points(axes: Axes, report: Report, metric: str, styles: dict[str, tuple[str, str]]) -> None:
    heading, _, sign = QUALITIES[metric]
    ahead = [report.rows[i] for i in report.front(metric)]
    corners = steps([row.ms for row in ahead], [getattr(row, metric) for row in ahead])
    axes.plot(*corners, color="#999999", lw=1.2, zorder=1, label="front: nothing beats these")
    for factor, (colour, marker) in styles.items():
        own = [r for r in report.rows if r.factor == factor and r.better(metric) is not None]
        axes.errorbar(
            [row.ms for row in own],
            [getattr(row, metric) for row in own],
            xerr=[[row.ms - row.p10 for row in own], [row.p90 - row.ms for row in own]],
            fmt=marker, color=colour, ms=11 if marker == STAR else 6.5, elinewidth=0.6,
            ecolor=colour, alpha=0.9, label=factor, zorder=2,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_xlabel("milliseconds a frame (whiskers: deciles)")
    axes.set_ylabel(f"{heading}, {'higher' if sign > 0 else 'lower'} is better")
    if sign < 0:
        axes.invert_yaxis()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.margins(x=0.16, y=0.1)
    axes.grid(visible=True, which="major", alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def training_picture(curves: Sequence[Curve]) -> bytes:
    """Held-out PSNR against minutes of training; seeds of one training share its colour."""
    figure = Figure(figsize=(7.6, 4.6), dpi=120, layout="constrained")
    axes = figure.subplots()
    labels = list(dict.fromkeys(curve.label for curve in curves))
    named: set[str] = set()
    for curve in curves:
        i = labels.index(curve.label)
        axes.plot(
            [second / 60 for second in curve.seconds],
            curve.psnr,
            color=ORDER[i % len(ORDER)],
            linestyle=DASHES[i % len(DASHES)],
            lw=1.5,
            label=None if curve.label in named else KNOWN.get(curve.label, curve.label),
        )
        named.add(curve.label)
    axes.set_xlabel("minutes of training")
    axes.set_ylabel("held-out PSNR dB, watched while training")
    axes.grid(visible=True, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=8.5, frameon=False, loc="lower right")
    return _png(figure)


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": ""})
    return stream.getvalue()
