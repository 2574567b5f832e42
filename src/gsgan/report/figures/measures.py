"""Numbers of the very pictures shown, and how they are written under them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from gsgan.metrics.image import edge_scores, psnr
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject

Numbers = dict[str, float | None]
STEP_ONE = "Step I's colour"


def measure(picture: Tensor, truth: Tensor, settings: Settings) -> Numbers:
    """PSNR, edge F1 and edge-pixel ratio of one picture ``[1, 3, h, w]`` as it is shown.

    Returns:
        ``psnr`` dB, ``edge_f1``, ``edge_ratio`` (edge pixels over the truth's); None where it is
        not defined: equal pictures, or a truth without edges.
    """
    f1, ratio = edge_scores(
        picture,
        truth,
        low=settings.canny_low,
        high=settings.canny_high,
        tolerance=settings.canny_tolerance,
    )
    return {
        "psnr": finite(psnr(picture, truth)),
        "edge_f1": finite(f1),
        "edge_ratio": finite(ratio),
    }


def finite(score: Tensor) -> float | None:
    """The number in a tensor of one; None where it is not finite."""
    value = float(score)
    return value if math.isfinite(value) else None


def written(value: float | None, digits: int, unit: str = "") -> str:
    """A number with its unit, or n/a."""
    return "n/a" if value is None else f"{value:.{digits}f}{unit}"


def decibels(numbers: Numbers) -> str:
    """PSNR as it stands under a picture."""
    return written(numbers["psnr"], 2, " dB")


def rivals(subjects: Sequence[Subject], shot: Shot) -> dict[str, Tensor]:
    """``[1, 3, h, w]`` pictures by name: each run's, and Step I's colour of the first.

    Step I's colour stands for splatting alone, unless a run given is that very baseline.
    """
    pictures = {subject.name: subject.image(shot) for subject in subjects}
    colour = subjects[0].colour(shot)
    if colour is not None and not any(s.model == "splat_only" for s in subjects):
        pictures[STEP_ONE] = colour
    return pictures


def where_from(shots: Sequence[Shot], margin: float) -> str:
    """Which pictures these are and on what part of them numbers were measured."""
    cameras = list(dict.fromkeys(shot.item[0] for shot in shots))
    listed = "; ".join(
        f"camera {camera} frame "
        + ", ".join(str(shot.item[1]) for shot in shots if shot.item[0] == camera)
        for camera in cameras
    )
    return (
        f"Pictures: {listed}. Numbers are of the windows shown, which reach at least {margin:g} m "
        "beyond the joints, not of whole pictures."
    )
