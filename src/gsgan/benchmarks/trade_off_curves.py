"""Held-out PSNR against seconds of training, read from the logs of runs."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

SECONDS, QUALITY = "val/seconds", "val/psnr"


@dataclass(frozen=True)
class Curve:
    """One training.

    Args:
        label: whose.
        seconds: of training until each validation, rising.
        psnr: dB, mean over the pictures watched.
    """

    label: str
    seconds: tuple[float, ...]
    psnr: tuple[float, ...]


def curve(label: str, run: Path) -> Curve | None:
    """The curve of a run folder, its resumed parts joined; None where its logs hold none.

    A part that went on from a checkpoint repeats what an interruption cut off after it: the later
    part counts.
    """
    points: list[tuple[float, float]] = []
    for log in sorted(run.glob("logs*/metrics.csv"), key=lambda path: path.parent.name):
        part = _validations(log)
        if part:
            points = [p for p in points if p[0] < part[0][0]] + part
    if len(points) < 2:
        return None
    seconds, psnr = zip(*points, strict=True)
    return Curve(label, seconds, psnr)


def _validations(log: Path) -> list[tuple[float, float]]:
    """(seconds, psnr) of each validation; rows that a kill cut short are passed over."""
    found = []
    with log.open(newline="") as stream:
        for row in csv.DictReader(stream):
            try:
                found.append((float(row[SECONDS]), float(row[QUALITY])))
            except (KeyError, TypeError, ValueError):
                continue
    return found
