"""Ablation: runs without a part beside the full one, with the place where they differ most."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from matplotlib.patches import Rectangle
from torch import Tensor
from torch.nn import functional

from gsgan.metrics.image import psnr
from gsgan.report.figures.layout import Drawing, Grid, Unavailable, aspect_of
from gsgan.report.figures.measures import decibels, finite, measure, where_from
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject
from gsgan.utils.palette import VERMILLION

Box = tuple[slice, slice]  # rows, columns


def draw(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Two rows a shot: the pictures, and below them the box in which the runs disagree most.

    The box is found by measurement, not chosen: where the spread between the runs' pictures is
    largest; the truth has no part in it, so that it favours none.

    Raises:
        Unavailable: with a single run.

    Source: the paper's ablation triplet (full, w/o GCN, w/o S).
    """
    if len(subjects) < 2:
        raise Unavailable("there is one run; give the ablations as compare=[<folder>,…]")
    titles = ["truth", *(subject.name for subject in subjects)]
    aspect = aspect_of([shot.truth for shot in shots])
    grid = Grid(2 * len(shots), len(titles), aspect, settings, width=settings.page, titles=titles)
    numbers: dict[str, dict[str, dict[str, float | None]]] = {}
    for row, shot in enumerate(shots):
        runs = [subject.image(shot) for subject in subjects]
        box = most_disputed(torch.cat(runs), settings.detail)
        _show(grid, 2 * row, 0, shot.truth, box)
        numbers[shot.name] = {}
        for column, (subject, picture) in enumerate(zip(subjects, runs, strict=True), start=1):
            found = measure(picture, shot.truth, settings)
            found["psnr_detail"] = finite(psnr(picture[..., *box], shot.truth[..., *box]))
            numbers[shot.name][subject.name] = found
            _show(grid, 2 * row, column, picture, box, found)
    caption = (
        "The truth and what each run paints of it, with PSNR; below, magnified, the box in which "
        "the runs' pictures differ most from each other, with PSNR in the box. "
        + where_from(shots, settings.margin)
    )
    return Drawing(grid.figure, caption, numbers)


def _show(
    grid: Grid,
    row: int,
    column: int,
    picture: Tensor,
    box: Box,
    found: dict[str, float | None] | None = None,
) -> None:
    """A picture with its box, and what is in the box below it."""
    axes = grid.picture(row, column, picture, decibels(found) if found else "")
    rows, columns = box
    corner = (columns.start, rows.start)
    size = (columns.stop - columns.start, rows.stop - rows.start)
    axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=VERMILLION, linewidth=0.8))
    note = decibels({"psnr": found["psnr_detail"]}) if found else ""
    detail = grid.picture(row + 1, column, picture[..., *box], note)
    detail.add_patch(Rectangle((0, 0), *size, fill=False, edgecolor=VERMILLION, linewidth=1.6))


def most_disputed(pictures: Tensor, share: float) -> Box:
    """Where pictures of one thing differ most: the box with the largest variance between them.

    Args:
        pictures: ``[runs, 3, h, w]``.
        share: the box's sides as a share of the pictures'.

    Returns:
        Rows and columns of the box, of the pictures' own shape.
    """
    spread = pictures.var(dim=0, unbiased=False).mean(dim=0)[None, None]
    size = [max(1, round(share * side)) for side in spread.shape[-2:]]
    sums = functional.avg_pool2d(spread.double(), size, stride=1)[0, 0]
    top, left = divmod(int(sums.argmax()), sums.shape[1])
    return slice(top, top + size[0]), slice(left, left + size[1])
