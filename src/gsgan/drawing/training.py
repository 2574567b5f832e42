"""Training: the watched pictures' PSNR against the minutes that each run has trained."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gsgan.drawing.layout import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    Drawing,
    Unavailable,
)
from gsgan.drawing.settings import Settings
from gsgan.drawing.shots import Shot
from gsgan.drawing.subjects import Subject

COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, BLACK)
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
HEIGHT = 0.75  # of the figure, as a share of its width
SECONDS, PICTURE, COLOUR = "val/seconds", "val/psnr", "val/psnr_splat"


@dataclass(frozen=True)
class Curve:
    """What a run's log says of its watched pictures, in the order it trained.

    Args:
        minutes: of training, an interruption left out.
        psnr: dB, of the picture.
        colour: dB, of Step I's colour; None where the log has none.
    """

    minutes: list[float]
    psnr: list[float]
    colour: list[float | None]


def read_curve(folder: Path) -> Curve:
    """The curve of a run folder. A run that was resumed has a log a part: where two tell of one
    iteration, the later one holds.

    Raises:
        Unavailable: when no log has watched pictures with their time.
    """
    points: dict[int, tuple[float, float, float | None]] = {}
    for path in sorted(folder.glob("logs*/metrics.csv")):
        for row in _rows(path):
            step, seconds, psnr = (_number(row, key) for key in ("step", SECONDS, PICTURE))
            if step is not None and seconds is not None and psnr is not None:
                points[int(step)] = seconds / 60, psnr, _number(row, COLOUR)
    if len(points) < 2:
        raise Unavailable(
            f"{folder} has no log of its training with two moments or more; logger=csv writes one"
        )
    ordered = [points[step] for step in sorted(points)]
    return Curve([p[0] for p in ordered], [p[1] for p in ordered], [p[2] for p in ordered])


def draw(subjects: Sequence[Subject], _: Sequence[Shot], settings: Settings) -> Drawing:
    """A line a run, Step I's colour of the same model dashed.

    Raises:
        Unavailable: when a run has no log.
    """
    curves = {subject.name: read_curve(subject.folder) for subject in subjects}
    size = (settings.column, HEIGHT * settings.column)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.add_subplot()
    for k, subject in enumerate(subjects):
        look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "lw": 1.0}
        curve = curves[subject.name]
        marker = MARKERS[k % len(MARKERS)]
        axes.plot(
            curve.minutes, curve.psnr, marker=marker, markersize=3, label=subject.name, **look
        )
        colour = [value for value in curve.colour if value is not None]
        if subject.avatar.generator is not None and len(colour) == len(curve.minutes):
            axes.plot(curve.minutes, colour, ls="--", **look)
    _frame(axes, curves, settings)
    numbers = {
        name: {"minutes": c.minutes, "psnr": c.psnr, "psnr_colour": c.colour}
        for name, c in curves.items()
    }
    caption = (
        "PSNR of the pictures that were watched while training (evenly spaced over the held-out "
        "poses, or what the data has in their place), against minutes of training; dashed, Step "
        "I's colour of the same model."
    )
    return Drawing(figure, caption, {"training": numbers})


def _frame(axes: Axes, curves: dict[str, Curve], settings: Settings) -> None:
    small = settings.font - 1
    axes.set_xlabel("minutes of training", fontsize=small)
    axes.set_ylabel("PSNR of watched pictures, dB", fontsize=small)
    axes.tick_params(labelsize=small)
    # the untrained start is many dB below all that is of interest
    shown = [value for c in curves.values() for value in c.psnr[1:]]
    room = 0.08 * max(max(shown) - min(shown), 0.1)
    axes.set_ylim(min(shown) - room, max(shown) + room)
    axes.set_xlim(left=0)
    axes.grid(visible=True, alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize=small, frameon=False, loc="lower right")


def _rows(path: Path) -> Iterator[dict[str, str | None]]:
    with path.open(newline="") as file:
        yield from csv.DictReader(file)


def _number(row: dict[str, str | None], key: str) -> float | None:
    """A finite number, or None: a line cut off by a kill has fewer fields."""
    try:
        value = float(row.get(key) or "nan")
    except ValueError:
        return None
    return value if math.isfinite(value) else None
