"""Canny edges: the truth's, ours, and those of splatting alone."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from matplotlib.colors import to_rgb
from torch import Tensor

from gsgan.metrics.image import canny
from gsgan.report.figures.layout import Drawing, Grid, aspect_of, extent, foot_lines
from gsgan.report.figures.measures import measure, rivals, where_from, written
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject
from gsgan.utils.palette import BLACK, SKY, VERMILLION

FOUND, MISSED, INVENTED = BLACK, SKY, VERMILLION


def draw(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """A column for the truth and one a picture; edge ratio and edge F1 under each.

    Edges of the truth that a picture lacks and edges that it invents have colours of their own.

    Source: the paper's Canny figure; edge ratio and F1 are ours.
    """
    pictures = [rivals(subjects, shot) for shot in shots]
    titles = ["truth", *pictures[0]]
    grid = Grid(
        len(shots),
        len(titles),
        aspect_of([shot.truth for shot in shots]),
        settings,
        width=settings.column if len(titles) <= 3 else settings.page,
        titles=titles,
        notes=2,
        foot=foot_lines(1, settings),
    )
    numbers: dict[str, dict[str, dict[str, float | None]]] = {}
    for row, (shot, drawn) in enumerate(zip(shots, pictures, strict=True)):
        truth = _edges(shot.truth, settings)
        _show(grid, row, 0, truth, truth, shot.truth, settings, f"{truth.sum()} px")
        numbers[shot.name] = {}
        for column, (name, picture) in enumerate(drawn.items(), start=1):
            found = measure(picture, shot.truth, settings)
            ratio, f1 = written(found["edge_ratio"], 2), written(found["edge_f1"], 3)
            note = f"ratio {ratio}\nF1 {f1}"
            _show(grid, row, column, _edges(picture, settings), truth, picture, settings, note)
            numbers[shot.name][name] = found
    grid.legend({"edge": FOUND, "missing": MISSED, "not in the truth": INVENTED}, columns=3)
    caption = (
        f"Canny edges (thresholds {settings.canny_low:g} and {settings.canny_high:g} on 8-bit "
        "grey); under the truth, how many pixels they are. Ratio: edge pixels over the truth's. "
        f"F1: of edges, {settings.canny_tolerance} px off allowed. "
        + where_from(shots, settings.margin)
    )
    return Drawing(grid.figure, caption, numbers)


def _edges(picture: Tensor, settings: Settings) -> np.ndarray:
    return canny(picture[0], settings.canny_low, settings.canny_high)


def _show(
    grid: Grid,
    row: int,
    column: int,
    edges: np.ndarray,
    truth: np.ndarray,
    picture: Tensor,
    settings: Settings,
    note: str,
) -> None:
    axes = grid.panel(row, column, note, framed=True)
    painted = paint_edges(edges, truth, settings.canny_tolerance)
    axes.imshow(painted, interpolation="nearest", extent=extent(picture))


def paint_edges(edges: np.ndarray, truth: np.ndarray, tolerance: int) -> np.ndarray:
    """Edges ``[h, w]`` as a picture ``[h, w, 3]`` of bytes on white, compared with the truth's.

    As edge F1 counts them: an edge is found where the other picture has one within ``tolerance``
    pixels.
    """
    kernel = np.ones((2 * tolerance + 1, 2 * tolerance + 1), np.uint8)
    near_truth = cv2.dilate(truth.astype(np.uint8), kernel) > 0
    near_edges = cv2.dilate(edges.astype(np.uint8), kernel) > 0
    painted = np.full((*edges.shape, 3), 255, np.uint8)
    painted[truth & ~near_edges] = _rgb(MISSED)
    painted[edges & near_truth] = _rgb(FOUND)
    painted[edges & ~near_truth] = _rgb(INVENTED)
    return painted


def _rgb(colour: str) -> list[int]:
    return [round(255 * value) for value in to_rgb(colour)]
