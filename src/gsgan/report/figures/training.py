"""The training figure: PSNR of the watched images against minutes of training."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from gsgan.report.curve import Curve, curve
from gsgan.report.figures.layout import Drawing, Settings, Unavailable
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject
from gsgan.utils.errors import DataError
from gsgan.utils.palette import COLOURS, MARKERS

HEIGHT = 0.75  # of the figure, as a share of its width


def training(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """A line per run, Step I's colour of the same model dashed.

    Raises:
        Unavailable: when a run has no log that can be read.
    """
    curves = [_curve(subject) for subject in subjects]
    figure = Figure((settings.column, HEIGHT * settings.column), layout="constrained")
    axes = figure.add_subplot()
    shown = []
    for k, (subject, found) in enumerate(zip(subjects, curves, strict=True)):
        minutes = [second / 60 for second in found.seconds]
        look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "lw": 1.0}
        axes.plot(minutes, found.psnr, marker=MARKERS[k % len(MARKERS)], markersize=3, **look)
        lines = [found.psnr]
        if subject.avatar.generator is not None and found.colour:
            axes.plot(minutes, found.colour, ls="--", **look)
            lines.append(found.colour)
        # without the untrained start, many dB below the rest
        shown += [v for line in lines for m, v in zip(minutes, line, strict=True) if m > 0]
    small = settings.font - 1
    axes.set_xlabel("minutes of training", fontsize=small)
    axes.set_ylabel("PSNR of watched images, dB", fontsize=small)
    axes.tick_params(labelsize=small)
    room = 0.08 * max(max(shown) - min(shown), 0.1)
    axes.set(xlim=(0, None), ylim=(min(shown) - room, max(shown) + room))
    axes.grid(visible=True, alpha=0.25)
    solid = [line for line in axes.lines if line.get_linestyle() == "-"]
    legend = axes.legend(solid, [""] * len(solid), fontsize=small, frameon=False, loc=4)
    for text, found in zip(legend.get_texts(), curves, strict=True):
        text.set(text=found.label, parse_math=False)
    numbers = {
        c.label: {"seconds": list(c.seconds), "psnr": list(c.psnr), "psnr_colour": list(c.colour)}
        for c in curves
    }
    caption = (
        f"PSNR of the {len(shots)} held-out images that were watched while training, against "
        "minutes of training; dashed, Step I's colour of the same model."
    )
    return Drawing(figure, caption, {"training": numbers})


def _curve(subject: Subject) -> Curve:
    try:
        found = curve(subject.name, subject.run.folder)
    except DataError as error:
        raise Unavailable(str(error)) from error
    if found is None or found.seconds[-1] <= 0:
        raise Unavailable(
            f"{subject.run.folder} has no log of two validations and their time (logger=csv "
            "writes one)"
        )
    return found
