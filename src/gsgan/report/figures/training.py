"""Training: the watched pictures' PSNR against the minutes that each run has trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gsgan.report.figures.layout import Drawing, Unavailable
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject
from gsgan.train.curve import Curve, curve
from gsgan.utils.errors import DataError
from gsgan.utils.palette import COLOURS, MARKERS

HEIGHT = 0.75  # of the figure, as a share of its width


def draw(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """A line a run, Step I's colour of the same model dashed.

    Raises:
        Unavailable: when a run has no log that can be read.
    """
    curves = [_curve(subject) for subject in subjects]
    size = (settings.column, HEIGHT * settings.column)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    for k, (subject, found) in enumerate(zip(subjects, curves, strict=True)):
        minutes = [second / 60 for second in found.seconds]
        look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "lw": 1.0}
        axes.plot(minutes, found.psnr, marker=MARKERS[k % len(MARKERS)], markersize=3, **look)
        if subject.avatar.generator is not None and found.colour:
            axes.plot(minutes, found.colour, ls="--", **look)
    _frame(axes, curves, settings)
    numbers = {
        c.label: {"seconds": list(c.seconds), "psnr": list(c.psnr), "psnr_colour": list(c.colour)}
        for c in curves
    }
    caption = (
        f"PSNR of the {len(shots)} held-out pictures that were watched while training, against "
        "minutes of training; dashed, Step I's colour of the same model."
    )
    return Drawing(figure, caption, {"training": numbers})


def _curve(subject: Subject) -> Curve:
    try:
        found = curve(subject.name, subject.folder)
    except DataError as error:
        raise Unavailable(str(error)) from error
    if found is None or found.seconds[-1] <= 0:
        raise Unavailable(
            f"{subject.folder} has no log that tells of two validations and their time "
            "(logger=csv writes one)"
        )
    return found


def _frame(axes: Axes, curves: Sequence[Curve], settings: Settings) -> None:
    small = settings.font - 1
    axes.set_xlabel("minutes of training", fontsize=small)
    axes.set_ylabel("PSNR of watched pictures, dB", fontsize=small)
    axes.tick_params(labelsize=small)
    shown = [
        value
        for c in curves
        for values in (c.psnr, c.colour)
        for second, value in zip(c.seconds, values, strict=False)
        if second > 0  # the untrained start is many dB below all that is of interest
    ]
    room = 0.08 * max(max(shown) - min(shown), 0.1)
    axes.set_ylim(min(shown) - room, max(shown) + room)
    axes.set_xlim(left=0)
    axes.grid(visible=True, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    lines = [line for line in axes.lines if line.get_linestyle() == "-"]
    legend = axes.legend(lines, [""] * len(lines), fontsize=small, frameon=False, loc="lower right")
    for text, c in zip(legend.get_texts(), curves, strict=True):
        text.set(text=c.label, parse_math=False)
