"""Held-out PSNR against seconds of training, read from the logs of runs."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from gsgan.utils.errors import DataError

SECONDS, QUALITY, COLOUR = "val/seconds", "val/psnr", "val/psnr_splat"


class Point(NamedTuple):
    """One validation: seconds of training, dB of the image and of Step I's colour, iteration."""

    seconds: float
    psnr: float
    colour: float | None
    step: float


@dataclass(frozen=True)
class Curve:
    """One training.

    Args:
        label: name of the run.
        seconds: of training until each validation, rising.
        psnr: dB, mean over the validation images.
        colour: dB, of Step I's colour; empty where the log lacks it.
    """

    label: str
    seconds: tuple[float, ...]
    psnr: tuple[float, ...]
    colour: tuple[float, ...] = ()


def curve(label: str, run: Path) -> Curve | None:
    """The curve of a run folder, its resumed parts joined; None where its logs hold none.

    A resumed part repeats the iterations after its checkpoint: the later part counts, from the
    iteration in its folder's name and from its first validation on.

    Raises:
        DataError: when a log cannot be read.
    """
    points: list[Point] = []
    for log in sorted(run.glob("logs*/metrics.csv"), key=lambda path: path.parent.name):
        part = _validations(log)
        if part:
            start, began = _start(log), part[0].seconds
            points = [p for p in points if p.seconds < began and p.step < start] + part
    if len(points) < 2:
        return None
    colour = tuple(p.colour for p in points if p.colour is not None)
    return Curve(
        label,
        tuple(p.seconds for p in points),
        tuple(p.psnr for p in points),
        colour if len(colour) == len(points) else (),
    )


def _validations(log: Path) -> list[Point]:
    """Each validation; an incomplete last line is skipped."""
    try:
        text = log.read_text(encoding="utf-8")
        rows = list(csv.DictReader(text[: text.rfind("\n") + 1].splitlines()))
    except (OSError, UnicodeError, csv.Error) as error:
        raise DataError(
            f"{log}: not a readable log of a training ({type(error).__name__}); remove it to go on "
            "without it"
        ) from error
    found: list[Point] = []
    for row in rows:
        seconds, psnr = _number(row, SECONDS), _number(row, QUALITY)
        if seconds is not None and psnr is not None:
            colour, step = _number(row, COLOUR), _number(row, "step")
            found.append(Point(seconds, psnr, colour, step or 0.0))
    return found


def _start(log: Path) -> float:
    """First iteration of a resumed part, from its folder's name, e.g. ``logs_000250``."""
    number = log.parent.name.rpartition("_")[2]
    return float(number) if number.isdecimal() else math.inf


def _number(row: dict[str, str], key: str) -> float | None:
    """A finite number, or None."""
    try:
        value = float(row.get(key) or "nan")
    except ValueError:
        return None
    return value if math.isfinite(value) else None
