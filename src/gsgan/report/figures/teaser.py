"""Teaser: skeletons in, pictures out."""

from __future__ import annotations

from collections.abc import Sequence

from gsgan.report.figures.body import draw_bones, open_panel, pose_of
from gsgan.report.figures.layout import Drawing, Grid, aspect_of
from gsgan.report.figures.measures import decibels, measure, where_from
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject


def draw(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Skeletons above what the first run paints for them, each with its own camera.

    Source: the paper's teaser.
    """
    subject = subjects[0]
    aspect = aspect_of([shot.truth for shot in shots])
    names = ["skeleton", "picture"]
    grid = Grid(2, len(shots), aspect, settings, width=settings.page, names=names, notes=0)
    numbers = {}
    for column, shot in enumerate(shots):
        draw_bones(open_panel(grid, 0, column, shot), pose_of(subject, shot), shot)
        picture = subject.image(shot)
        grid.picture(1, column, picture)
        numbers[shot.name] = {subject.name: measure(picture, shot.truth, settings)}
    each = ", ".join(decibels(found[subject.name]) for found in numbers.values())
    caption = (
        f"Skeletons and cameras (above) and the pictures that {subject.name} paints for them "
        f"(below); PSNR from left to right {each}. " + where_from(shots, settings.margin)
    )
    return Drawing(grid.figure, caption, numbers)
