"""Densify: skeleton, body points, deformed Gaussians and picture through one camera."""

from __future__ import annotations

from collections.abc import Sequence

from gsgan.model.body_points import BodyPoints
from gsgan.report.figures.body import draw_bones, draw_gaussians, draw_points, open_panel, pose_of
from gsgan.report.figures.layout import Drawing, Grid, Unavailable, aspect_of
from gsgan.report.figures.measures import decibels, measure, where_from
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject
from gsgan.skeleton import Densify

POINTS = {
    Densify: "the points that Algorithm 1 puts on cylinders, sphere and box, coloured by part, "
    "pale on the side of the part that faces away",
    BodyPoints: "points of the posed body's surface, coloured by the bone that moves them most",
}
TITLES = ("(a) skeleton", "(b) points", "(c) Gaussians", "(d) picture", "(e) truth")


def draw(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """One row a shot, of the first run: from the bones to the picture.

    Raises:
        Unavailable: when the model does not densify.

    Source: the paper's densify figure (skeleton, points), with what Ψ makes of them.
    """
    subject = subjects[0]
    placed = subject.avatar.body_points or subject.avatar.densify
    if placed is None:
        raise Unavailable(f"{subject.name} has no densify: its model makes no points of a skeleton")
    aspect = aspect_of([shot.truth for shot in shots])
    grid = Grid(len(shots), len(TITLES), aspect, settings, width=settings.page, titles=TITLES)
    numbers = {}
    for row, shot in enumerate(shots):
        pose, painting = pose_of(subject, shot), subject.paint(shot)
        image = subject.image(shot)
        found = measure(image, shot.truth, settings)
        seen = int(pose.valid.sum())
        draw_bones(open_panel(grid, row, 0, shot, f"{seen} joints"), pose, shot)
        axes = open_panel(grid, row, 1, shot, f"N = {placed.n_points}")
        points = draw_points(axes, placed, pose, shot)
        axes = open_panel(grid, row, 2, shot, f"{settings.sigmas:g} σ")
        assert painting.gaussians is not None
        accuracy = subject.avatar.accuracy
        drawn = draw_gaussians(axes, painting.gaussians, shot, accuracy, settings.sigmas)
        grid.picture(row, 3, image, decibels(found))
        grid.picture(row, 4, shot.truth)
        counts = {"joints": seen, "points": points, "gaussians": drawn}
        numbers[shot.name] = {subject.name: found | counts}
    caption = (
        f"From skeleton to picture through one camera: (a) the joints; (b) {POINTS[type(placed)]}; "
        "(c) the Gaussians after Ψ, filled to "
        f"{settings.sigmas:g} σ with their own colour and opacity; (d) the picture; (e) the truth. "
        + where_from(shots, settings.margin)
    )
    return Drawing(grid.figure, caption, numbers)
