"""Every figure by name: the one place that knows them all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gsgan.report.figures import (
    ablation,
    canny,
    comparison,
    densify,
    errors,
    segmentation,
    strip,
    teaser,
    training,
)
from gsgan.report.figures.layout import Drawing
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject

Draw = Callable[[Sequence[Subject], Sequence[Shot], Settings], Drawing]


@dataclass(frozen=True)
class Kind:
    """How a figure is made.

    Args:
        draw: subjects, the first one leading, and shots to a drawing.
        one_camera: all its shots come from one camera.
        compares: it needs a second run.
        watched: it is of the pictures that were watched while training, not of a split's.
    """

    draw: Draw
    one_camera: bool = False
    compares: bool = False
    watched: bool = False


KINDS = {
    "teaser": Kind(teaser.draw),
    "densify": Kind(densify.draw),
    "segmentation": Kind(segmentation.draw),
    "canny": Kind(canny.draw),
    "errors": Kind(errors.draw),
    "strip": Kind(strip.draw, one_camera=True),
    "comparison": Kind(comparison.draw, compares=True),
    "ablation": Kind(ablation.draw, compares=True),
    "training": Kind(training.draw, watched=True),
}
