"""Figures of images side by side: teaser, strip, comparison, ablation, canny, errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.patches import Rectangle
from torch import Tensor
from torch.nn import functional

from gsgan.metrics.image import canny as canny_edges
from gsgan.metrics.image import psnr
from gsgan.report.figures.body import draw_bones, open_panel, pose_of
from gsgan.report.figures.layout import (
    BAR_FOOT,
    Drawing,
    Panels,
    Settings,
    Unavailable,
    legend_foot,
    written,
)
from gsgan.report.figures.shots import Shot, aspect_of
from gsgan.report.figures.subjects import Numbers, Subject, finite, measure, rivals
from gsgan.utils.palette import BLACK, SKY, VERMILLION

FOUND, MISSED, INVENTED = BLACK, SKY, VERMILLION  # edges
ERROR_COLOURS = "magma_r"  # pale is no error; even steps of lightness, in grey print too
LEVELS = 255.0
Images = list[dict[str, Tensor]]  # per shot, by name
Box = tuple[slice, slice]  # rows, columns


def teaser(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Skeletons above the first run's images, each with its own camera.

    Source: the paper's teaser.
    """
    subject = subjects[0]
    images = [{subject.name: subject.image(shot)} for shot in shots]
    numbers = _measured(images, shots, settings)
    panels = Panels(
        2, len(shots), settings, aspect=aspect_of(shots), width=settings.page,
        names=["skeleton", "image"], notes=0,
    )  # fmt: skip
    for column, shot in enumerate(shots):
        draw_bones(open_panel(panels, 0, column, shot), pose_of(subject, shot), shot)
        panels.show(1, column, images[column][subject.name])
    each = ", ".join(_decibels(numbers[shot.name][subject.name]) for shot in shots)
    caption = (
        f"Skeletons and cameras (above) and the images that {subject.name} makes of them (below); "
        f"PSNR from left to right {each}."
    )
    return Drawing(panels.figure, caption, numbers)


def strip(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """One camera over time: a row for the ground truth and one per run, PSNR below each image.

    Source: the paper's strip of the sign language sequence.
    """
    images = [{s.name: s.image(shot) for s in subjects} for shot in shots]
    numbers = _measured(images, shots, settings)
    panels = Panels(
        1 + len(subjects), len(shots), settings, aspect=aspect_of(shots), width=settings.page,
        titles=[f"frame {shot.item[1]}" for shot in shots],
        names=["truth", *images[0]],
    )  # fmt: skip
    for column, shot in enumerate(shots):
        panels.show(0, column, shot.truth)
        for row, (name, image) in enumerate(images[column].items(), start=1):
            panels.show(row, column, image, _decibels(numbers[shot.name][name]))
    caption = "One camera over time: the ground truth and each run's images, with PSNR."
    return Drawing(panels.figure, caption, numbers)


def comparison(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """A row per shot: the ground truth and each run's image, with PSNR and edge F1.

    Source: the paper's comparison figure.
    """
    images = [{s.name: s.image(shot) for s in subjects} for shot in shots]
    numbers = _measured(images, shots, settings)
    panels = _row_per_shot(images, shots, settings, notes=2)
    for row, shot in enumerate(shots):
        panels.show(row, 0, shot.truth)
        for column, (name, image) in enumerate(images[row].items(), start=1):
            found = numbers[shot.name][name]
            note = f"{_decibels(found)}\nF1 {written(found['edge_f1'], 3)}"
            panels.show(row, column, image, note)
    caption = "The ground truth and each run's image, with PSNR and the F1 of Canny edges."
    return Drawing(panels.figure, caption, numbers)


def ablation(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Two rows per shot: the images, and below them the box in which the runs differ most.

    The box is measured, not chosen: where the variance between the runs' images is largest. The
    ground truth has no part in it, so it favours no run.

    Source: the paper's ablation triplet (full, w/o GCN, w/o S).
    """
    images = [{s.name: s.image(shot) for s in subjects} for shot in shots]
    numbers = _measured(images, shots, settings)
    panels = _row_per_shot(images, shots, settings, rows=2)
    for i, shot in enumerate(shots):
        box = most_disputed(torch.cat(list(images[i].values())), settings.detail)
        rows, columns = box
        size = (columns.stop - columns.start, rows.stop - rows.start)
        for column, (name, image) in enumerate([("", shot.truth), *images[i].items()]):
            notes = ["", ""]
            if name:
                found = numbers[shot.name][name]
                found["psnr_detail"] = finite(psnr(image[..., *box], shot.truth[..., *box]))
                notes = [written(found[key], 2, " dB") for key in ("psnr", "psnr_detail")]
            frame: dict[str, Any] = {"fill": False, "edgecolor": VERMILLION}
            axes = panels.show(2 * i, column, image, notes[0])
            axes.add_patch(Rectangle((columns.start, rows.start), *size, lw=0.8, **frame))
            axes = panels.show(2 * i + 1, column, image[..., *box], notes[1])
            axes.add_patch(Rectangle((0, 0), *size, lw=1.6, **frame))
    caption = (
        "The ground truth and each run's image, with PSNR; below, magnified, the box in which the "
        "runs' images differ most from each other, with PSNR in the box."
    )
    return Drawing(panels.figure, caption, numbers)


def most_disputed(images: Tensor, share: float) -> Box:
    """The box with the largest variance between images of one thing.

    Args:
        images: ``[runs, 3, h, w]``.
        share: the box's sides as a share of the images'.

    Returns:
        Rows and columns of the box, of the images' own aspect.
    """
    spread = images.var(dim=0, unbiased=False).mean(dim=0)[None, None]
    size = [max(1, round(share * side)) for side in spread.shape[-2:]]
    sums = functional.avg_pool2d(spread.double(), size, stride=1)[0, 0]
    top, left = divmod(int(sums.argmax()), sums.shape[1])
    return slice(top, top + size[0]), slice(left, left + size[1])


def canny(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Canny edges of the ground truth and of each image, with edge ratio and edge F1.

    Missing and invented edges have colours of their own.

    Source: the paper's Canny figure; edge ratio and F1 are ours.
    """
    images = [rivals(subjects, shot) for shot in shots]
    numbers = _measured(images, shots, settings)
    panels = _row_per_shot(images, shots, settings, notes=2, foot=legend_foot(1, settings))
    for row, shot in enumerate(shots):
        truth = canny_edges(shot.truth[0], settings.canny_low, settings.canny_high)
        for column, (name, image) in enumerate([("", shot.truth), *images[row].items()]):
            edges = canny_edges(image[0], settings.canny_low, settings.canny_high)
            note = f"{truth.sum()} px"
            if name:
                found = numbers[shot.name][name]
                note = f"ratio {written(found['edge_ratio'], 2)}\nF1 {written(found['edge_f1'], 3)}"
            painted = paint_edges(edges, truth, settings.canny_tolerance)
            panels.show(row, column, painted, note, framed=True)
    panels.legend({"edge": FOUND, "missing": MISSED, "not in the truth": INVENTED}, columns=3)
    caption = (
        f"Canny edges (thresholds {settings.canny_low:g} and {settings.canny_high:g} on 8-bit "
        "grey); below the ground truth, their number of pixels. Ratio: edge pixels over the ground "
        f"truth's. F1: of edges, {settings.canny_tolerance} px off allowed."
    )
    return Drawing(panels.figure, caption, numbers)


def paint_edges(edges: np.ndarray, truth: np.ndarray, tolerance: int) -> np.ndarray:
    """Edges ``[h, w]`` as an RGB image ``[h, w, 3]`` of bytes on white.

    As in edge F1, an edge is found where the other image has one within ``tolerance`` pixels.
    """
    kernel = np.ones((2 * tolerance + 1, 2 * tolerance + 1), np.uint8)
    near_truth, near_edges = (cv2.dilate(e.astype(np.uint8), kernel) > 0 for e in (truth, edges))
    painted = np.full((*edges.shape, 3), 255, np.uint8)
    for colour, where in (
        (MISSED, truth & ~near_edges),
        (FOUND, edges & near_truth),
        (INVENTED, edges & ~near_truth),
    ):
        painted[where] = np.round(255 * np.array(to_rgb(colour)))
    return painted


def errors(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Ground truth, images and their absolute errors; one scale, the mean below each map.

    Raises:
        Unavailable: when there is nothing to compare with.

    Source: the paper's error maps of GaussianGAN and splatting alone.
    """
    images = [rivals(subjects, shot) for shot in shots]
    names = list(images[0])
    if len(names) < 2:
        raise Unavailable(f"{names[0]} has no second image; add a run as compare=[<folder>]")
    numbers = _measured(images, shots, settings)
    maps = [
        {name: error_levels(image, shot.truth) for name, image in held.items()}
        for shot, held in zip(shots, images, strict=True)
    ]
    every = torch.cat([error.flatten() for held in maps for error in held.values()])
    top = settings.error_max or scale_end(every)
    scale = Normalize(0, top)
    panels = Panels(
        len(shots), 1 + 2 * len(names), settings, aspect=aspect_of(shots), width=settings.page,
        titles=["truth", *(f"{name}\n{what}" for what in ("image", "error") for name in names)],
        foot=BAR_FOOT,
    )  # fmt: skip
    for row, shot in enumerate(shots):
        panels.show(row, 0, shot.truth)
        for column, (name, image) in enumerate(images[row].items(), start=1):
            error, found = maps[row][name], numbers[shot.name][name]
            found["error_mean"] = float(error.mean())
            panels.show(row, column, image, _decibels(found))
            panels.show(
                row, column + len(names), error.numpy(), f"mean {error.mean():.2f}", framed=True,
                cmap=ERROR_COLOURS, norm=scale,
            )  # fmt: skip
    label = "absolute error, mean of R, G and B (levels of 255)"
    panels.bar(ScalarMappable(scale, ERROR_COLOURS), label, over=bool((every > top).any()))
    caption = (
        "Absolute error of each pixel, mean over the three channels, in levels of 255; one scale "
        f"for all maps, which ends at {top:g}. The mean over the window is below each map."
    )
    return Drawing(panels.figure, caption, numbers)


def error_levels(image: Tensor, truth: Tensor) -> Tensor:
    """``[h, w]``: |image - truth| of ``[1, 3, h, w]``, mean over channels, levels of 255."""
    return (image - truth).abs().mean(dim=1)[0].double() * LEVELS


def scale_end(values: Tensor) -> float:
    """The 99.5th percentile, rounded up to five levels."""
    high = float(np.percentile(values.numpy(), 99.5, method="inverted_cdf"))
    return max(5.0, 5.0 * math.ceil(high / 5.0))


def _measured(
    images: Images, shots: Sequence[Shot], settings: Settings
) -> dict[str, dict[str, Numbers]]:
    """The measures of each image, by shot and name."""
    return {
        shot.name: {name: measure(image, shot.truth, settings) for name, image in held.items()}
        for shot, held in zip(shots, images, strict=True)
    }


def _row_per_shot(
    images: Images, shots: Sequence[Shot], settings: Settings, rows: int = 1, **how: Any
) -> Panels:
    """Panels with a column for the ground truth and one per image."""
    titles = ["truth", *images[0]]
    width = settings.column if len(titles) <= 3 else settings.page
    aspect = aspect_of(shots)
    return Panels(
        rows * len(shots), len(titles), settings, aspect=aspect, width=width, titles=titles, **how
    )


def _decibels(found: Numbers) -> str:
    return written(found["psnr"], 2, " dB")
