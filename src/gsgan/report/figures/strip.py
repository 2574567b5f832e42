"""Strip: one camera, moment after moment, the truth above what each run paints."""

from __future__ import annotations

from collections.abc import Sequence

from gsgan.report.figures.layout import Drawing, Grid, aspect_of
from gsgan.report.figures.measures import decibels, measure, where_from
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject


def draw(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """A row for the truth and one a run, a column a shot; PSNR under each picture.

    Source: the paper's strip of the sign language sequence.
    """
    grid = Grid(
        1 + len(subjects),
        len(shots),
        aspect_of([shot.truth for shot in shots]),
        settings,
        width=settings.page,
        titles=[f"frame {shot.item[1]}" for shot in shots],
        names=["truth", *(subject.name for subject in subjects)],
        notes=[0] + [1] * len(subjects),
    )
    numbers: dict[str, dict[str, dict[str, float | None]]] = {}
    for column, shot in enumerate(shots):
        grid.picture(0, column, shot.truth)
        numbers[shot.name] = {}
        for row, subject in enumerate(subjects, start=1):
            picture = subject.image(shot)
            found = measure(picture, shot.truth, settings)
            grid.picture(row, column, picture, decibels(found))
            numbers[shot.name][subject.name] = found
    caption = "One camera over time: the truth and what each run paints, with PSNR. " + where_from(
        shots, settings.margin
    )
    return Drawing(grid.figure, caption, numbers)
