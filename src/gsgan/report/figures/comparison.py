"""Comparison: the truth and every run's picture of it, a row a shot."""

from __future__ import annotations

from collections.abc import Sequence

from gsgan.report.figures.layout import Drawing, Grid, Unavailable, aspect_of
from gsgan.report.figures.measures import decibels, measure, where_from, written
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject


def draw(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Columns are truth and runs; PSNR and edge F1 stand under each picture.

    Raises:
        Unavailable: with a single run.

    Source: the paper's comparison figure.
    """
    if len(subjects) < 2:
        raise Unavailable("there is one run; give others as compare=[<folder>,…]")
    aspect = aspect_of([shot.truth for shot in shots])
    titles = ["truth", *(subject.name for subject in subjects)]
    grid = Grid(
        len(shots), len(titles), aspect, settings, width=settings.page, titles=titles, notes=2
    )
    numbers: dict[str, dict[str, dict[str, float | None]]] = {}
    for row, shot in enumerate(shots):
        grid.picture(row, 0, shot.truth)
        numbers[shot.name] = {}
        for column, subject in enumerate(subjects, start=1):
            picture = subject.image(shot)
            found = measure(picture, shot.truth, settings)
            note = f"{decibels(found)}\nF1 {written(found['edge_f1'], 3)}"
            grid.picture(row, column, picture, note)
            numbers[shot.name][subject.name] = found
    caption = (
        "The truth and what each run paints of it, with PSNR and the F1 of Canny edges. "
        + where_from(shots, settings.margin)
    )
    return Drawing(grid.figure, caption, numbers)
