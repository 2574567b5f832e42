"""Table and plots of the trade-off bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from gsgan.bench.common import NOTHING, markdown, number, panels, plain_ticks, png, sentence
from gsgan.report.curve import Curve
from gsgan.utils.palette import BLACK, COLOURS, DASHES, GREY, MARKERS

# Metric: heading, digits, and 1 where more is better, -1 where less is.
QUALITIES = {
    "psnr": ("PSNR dB", 2, 1),
    "ssim": ("SSIM", 4, 1),
    "edge_f1": ("edge F1", 3, 1),
    "lpips": ("LPIPS", 4, -1),
}
ORDER = (BLACK, *COLOURS[:-1], GREY)  # the base point's first
TITLES = {
    "base": "Step I and II (full)",
    "full": "Step I and II (full)",
    "splat_only": "Step I only (splat_only)",
    "lbs_splat": "baseline: Gaussians on the body (lbs_splat)",
    "image_to_image": "baseline: UNet on the drawn skeleton (image_to_image)",
}
# Labels beside points, in turn: offset in points, horizontal and vertical alignment.
PLACES = ((0, 6, "center", "bottom"), (0, -6, "center", "top"), (7, 0, "left", "center"))


def front(frame: pd.DataFrame, metric: str) -> list[int]:
    """The Pareto front: indices of the rows that no other beats, from the fastest up.

    Convention: a row is beaten when another is at least as good in time and in the metric, and
    better in one; of equal rows all stay; those without a score are left out.
    """
    ms = frame.ms.to_numpy()
    score = frame[metric].to_numpy(dtype=float) * QUALITIES[metric][2]
    found = []
    for i in np.argsort(ms, kind="stable").tolist():
        least = (ms <= ms[i]) & (score >= score[i])
        beaten = least & ((ms < ms[i]) | (score > score[i]))
        if np.isfinite(score[i]) and not beaten.any():
            found.append(i)
    return found


def text(
    frame: pd.DataFrame,
    metric: str,
    about: Mapping[str, Any],
    where: Mapping[str, Any],
    marks: Sequence[str],
    *,
    has_curves: bool,
) -> str:
    """The block of the page, less its plots.

    Args:
        frame: see ``trade_off.make_rows``.
        metric: that the front is about.
        about: ``pictures``, ``split`` and ``subject``.
        where: the machine.
        marks: notes that the table must carry.
        has_curves: whether training times are known.
    """
    notes = list(marks)
    if frame.lpips.isna().all():
        notes.append("LPIPS n/a: the backbone's weights are not available")
    if frame.left_out.any():
        notes.append(f"{frame.left_out.sum()} scores were not finite and are not in the means")
    if not has_curves:
        notes.append("no training times: the runs' logs hold none (val/seconds)")
    heading = (
        f"{about['pictures']} images of {about['split']}; settings changed on {about['subject']}; "
        f"one image at a time. Front: nothing is as fast and scores as much "
        f"({QUALITIES[metric][0]})."
    )
    listed = "\n".join(f"- {note}" for note in notes)
    return f"{sentence(where)}.\n\n{heading}\n\n{table(frame, metric)}\n\n{listed}".strip()


def table(frame: pd.DataFrame, metric: str) -> str:
    """The rows in Markdown."""
    seeds = [f" ({n} seeds)" if n > 1 else "" for n in frame.seeds]
    shown = pd.DataFrame({"changed": frame.factor, "to": frame.label + seeds})
    for name, (heading, digits, _) in QUALITIES.items():
        if frame[name].notna().any():
            shown[heading] = [NOTHING if pd.isna(v) else f"{v:.{digits}f}" for v in frame[name]]
    shown["ms per frame"] = frame.ms.map(number)
    shown["10–90 %"] = frame.p10.map(number) + "–" + frame.p90.map(number)
    shown["peak MB"] = frame.memory_mb.map(number)
    shown["training min"] = (frame.seconds / 60).map(number)
    best = front(frame, metric)
    shown["front"] = ["yes" if i in best else "" for i in range(len(frame))]
    return markdown(shown)


def images(
    frame: pd.DataFrame, quality: str, second: str, curves: Sequence[Curve]
) -> dict[str, bytes]:
    """The plots as PNG bytes by file name; without curves there is only the first."""
    metrics = [m for m in dict.fromkeys((quality, second)) if frame[m].notna().any()]
    found = {"trade_off.png": trade_off_plot(frame, metrics or [quality])}
    return found | ({"trade_off_training.png": training_plot(curves)} if curves else {})


def trade_off_plot(frame: pd.DataFrame, metrics: Sequence[str]) -> bytes:
    """Metrics against milliseconds per frame, all points labelled, the front as a step line."""
    figure, all_axes = panels(len(metrics), 6.4 * len(metrics), 5.6)
    for axes, metric in zip(all_axes, metrics, strict=True):
        heading, _, sign = QUALITIES[metric]
        ahead = frame.iloc[front(frame, metric)]
        label = "front: nothing beats these"
        axes.step(ahead.ms, ahead[metric], "#999999", where="post", lw=1.2, zorder=1, label=label)
        for i, (factor, own) in enumerate(frame.groupby("factor", sort=False)):
            axes.errorbar(
                own.ms,
                own[metric],
                xerr=[own.ms - own.p10, own.p90 - own.ms],
                fmt=MARKERS[i % len(MARKERS)] if i else "*",
                color=ORDER[i % len(ORDER)],
                ms=6.5 if i else 11,
                elinewidth=0.6,
                label=factor,
            )
        axes.set(xscale="log", xlabel="milliseconds per frame (whiskers: deciles)")
        axes.set_ylabel(f"{heading}, {'higher' if sign > 0 else 'lower'} is better")
        plain_ticks(axes.xaxis)
        axes.margins(x=0.16, y=0.1)
        if sign < 0:
            axes.invert_yaxis()
        for i, (_, row) in enumerate(frame[frame[metric].notna()].sort_values("ms").iterrows()):
            dx, dy, ha, va = PLACES[i % len(PLACES)]
            axes.annotate(
                row.label,
                (row.ms, row[metric]),
                (dx, dy),
                textcoords="offset points",
                ha=ha,
                va=va,
                fontsize=7.5,
            )
    handles, names = all_axes[0].get_legend_handles_labels()
    figure.legend(
        handles, names, loc="outside lower center", ncols=min(6, len(names)), frameon=False
    )
    return png(figure)


def training_plot(curves: Sequence[Curve]) -> bytes:
    """Held-out PSNR against minutes of training; seeds of one training share its colour."""
    figure, (axes,) = panels(1, 7.6, 4.6)
    labels = list(dict.fromkeys(curve.label for curve in curves))
    for k, curve in enumerate(curves):
        i = labels.index(curve.label)
        first = curve.label not in [c.label for c in curves[:k]]
        axes.plot(
            np.divide(curve.seconds, 60),
            curve.psnr,
            color=ORDER[i % len(ORDER)],
            linestyle=DASHES[i % len(DASHES)],
            label=TITLES.get(curve.label, curve.label) if first else None,
        )
    axes.set(xlabel="minutes of training", ylabel="held-out PSNR dB, logged while training")
    axes.legend(fontsize=8.5, frameon=False, loc="lower right")
    return png(figure)
