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
from gsgan.report.figures.body import draw_bones, pose_of
from gsgan.report.figures.layout import (
    BAR_FOOT,
    Drawing,
    Panel,
    Settings,
    Sheet,
    Unavailable,
    legend_foot,
    written,
)
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Numbers, Subject, finite, measure, rivals
from gsgan.utils.palette import BLACK, SKY, VERMILLION

FOUND, MISSED, INVENTED = BLACK, SKY, VERMILLION  # edges
ERROR_COLOURS = "magma_r"  # pale is no error; even steps of lightness, in grey print too
LEVELS = 255.0
Images = list[dict[str, Tensor]]  # per shot, by name


def teaser(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Skeletons above the first run's images, each with its own camera.

    Source: the paper's teaser.
    """
    subject = subjects[0]
    images = _images([subject], shots)
    numbers = _measured(images, shots, settings)
    below = [Panel(image) for held in images for image in held.values()]
    panels = [[Panel(None, framed=True)] * len(shots), below]
    sheet = Sheet(panels, settings, width=settings.page, names=["skeleton", "image"])
    for axes, shot in zip(sheet.axes[0], shots, strict=True):
        draw_bones(axes, pose_of(subject, shot), shot)
    each = ", ".join(_decibels(numbers[shot.name][subject.name]) for shot in shots)
    caption = (
        f"Skeletons and cameras (above) and the images that {subject.name} makes of them (below); "
        f"PSNR from left to right {each}."
    )
    return Drawing(sheet.figure, caption, numbers)


def strip(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """One camera over time: a row for the ground truth and one per run, PSNR below each image.

    Source: the paper's strip of the sign language sequence.
    """
    images = _images(subjects, shots)
    numbers = _measured(images, shots, settings)
    panels = [[Panel(shot.truth) for shot in shots]]
    for name in images[0]:
        notes = [_decibels(numbers[shot.name][name]) for shot in shots]
        panels.append([Panel(x[name], note) for x, note in zip(images, notes, strict=True)])
    titles, names = [f"frame {shot.item[1]}" for shot in shots], ["truth", *images[0]]
    sheet = Sheet(panels, settings, width=settings.page, titles=titles, names=names)
    caption = "One camera over time: the ground truth and each run's images, with PSNR."
    return Drawing(sheet.figure, caption, numbers)


def comparison(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """A row per shot: the ground truth and each run's image, with PSNR and edge F1.

    Source: the paper's comparison figure.
    """
    images = _images(subjects, shots)
    numbers = _measured(images, shots, settings)
    panels = []
    for shot, held in zip(shots, images, strict=True):
        panels.append([Panel(shot.truth)])
        for name, image in held.items():
            found = numbers[shot.name][name]
            note = f"{_decibels(found)}\nF1 {written(found['edge_f1'], 3)}"
            panels[-1].append(Panel(image, note))
    sheet = Sheet(panels, settings, width=settings.page, titles=["truth", *images[0]])
    caption = "The ground truth and each run's image, with PSNR and the F1 of Canny edges."
    return Drawing(sheet.figure, caption, numbers)


def ablation(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Two rows per shot: the images, and below them the box in which the runs differ most.

    The box is measured, not chosen: where the variance between the runs' images is largest. The
    ground truth has no part in it, so it favours no run.

    Source: the paper's ablation triplet (full, w/o GCN, w/o S).
    """
    images = _images(subjects, shots)
    numbers = _measured(images, shots, settings)
    panels: list[list[Panel]] = []
    boxes: list[tuple[slice, slice] | None] = []
    for shot, held in zip(shots, images, strict=True):
        box = most_disputed(torch.cat(list(held.values())), settings.detail)
        above, below = [Panel(shot.truth)], [Panel(shot.truth[..., *box])]
        for name, image in held.items():
            found = numbers[shot.name][name]
            found["psnr_detail"] = finite(psnr(image[..., *box], shot.truth[..., *box]))
            above.append(Panel(image, _decibels(found)))
            below.append(Panel(image[..., *box], written(found["psnr_detail"], 2, " dB")))
        panels += [above, below]
        boxes += [box, None]
    sheet = Sheet(panels, settings, width=settings.page, titles=["truth", *images[0]])
    for row, shown in zip(sheet.axes, boxes, strict=True):
        for axes in row:
            if shown is None:  # the magnified
                axes.spines[:].set(visible=True, color=VERMILLION, linewidth=1.6)
                continue
            (top, height), (left, width) = ((side.start, side.stop - side.start) for side in shown)
            axes.add_patch(Rectangle((left, top), width, height, fill=False, ec=VERMILLION, lw=0.8))
    caption = (
        "The ground truth and each run's image, with PSNR; below, magnified, the box in which the "
        "runs' images differ most from each other, with PSNR in the box."
    )
    return Drawing(sheet.figure, caption, numbers)


def most_disputed(images: Tensor, share: float) -> tuple[slice, slice]:
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
    low, high, tolerance = settings.canny_low, settings.canny_high, settings.canny_tolerance
    panels = []
    for shot, held in zip(shots, images, strict=True):
        truth = canny_edges(shot.truth[0], low, high)
        painted = paint_edges(truth, truth, tolerance)
        panels.append([Panel(painted, f"{truth.sum()} px", framed=True)])
        for name, image in held.items():
            found = numbers[shot.name][name]
            note = f"ratio {written(found['edge_ratio'], 2)}\nF1 {written(found['edge_f1'], 3)}"
            painted = paint_edges(canny_edges(image[0], low, high), truth, tolerance)
            panels[-1].append(Panel(painted, note, framed=True))
    titles, foot = ["truth", *images[0]], legend_foot(1, settings)
    width = settings.column if len(titles) <= 3 else settings.page
    sheet = Sheet(panels, settings, width=width, titles=titles, foot=foot)
    sheet.legend({"edge": FOUND, "missing": MISSED, "not in the truth": INVENTED}, columns=3)
    caption = (
        f"Canny edges (thresholds {low:g} and {high:g} on 8-bit grey); below the ground truth, "
        "their number of pixels. Ratio: edge pixels over the ground truth's. F1: of edges, "
        f"{tolerance} px off allowed."
    )
    return Drawing(sheet.figure, caption, numbers)


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
    how: dict[str, Any] = {"cmap": ERROR_COLOURS, "norm": Normalize(0, top)}
    panels = []
    for shot, held, found in zip(shots, images, maps, strict=True):
        panels.append([Panel(shot.truth)])
        for name, image in held.items():
            numbers[shot.name][name]["error_mean"] = float(found[name].mean())
            panels[-1].append(Panel(image, _decibels(numbers[shot.name][name])))
        panels[-1] += [
            Panel(error.numpy(), f"mean {error.mean():.2f}", framed=True, how=how)
            for error in found.values()
        ]
    titles = ["truth", *(f"{name}\n{what}" for what in ("image", "error") for name in names)]
    sheet = Sheet(panels, settings, width=settings.page, titles=titles, foot=BAR_FOOT)
    label = "absolute error, mean of R, G and B (levels of 255)"
    sheet.bar(ScalarMappable(how["norm"], ERROR_COLOURS), label, over=bool((every > top).any()))
    caption = (
        "Absolute error of each pixel, mean over the three channels, in levels of 255; one scale "
        f"for all maps, which ends at {top:g}. The mean over the window is below each map."
    )
    return Drawing(sheet.figure, caption, numbers)


def error_levels(image: Tensor, truth: Tensor) -> Tensor:
    """``[h, w]``: |image - truth| of ``[1, 3, h, w]``, mean over channels, levels of 255."""
    return (image - truth).abs().mean(dim=1)[0].double() * LEVELS


def scale_end(values: Tensor) -> float:
    """The 99.5th percentile, rounded up to five levels."""
    high = float(np.percentile(values.numpy(), 99.5, method="inverted_cdf"))
    return max(5.0, 5.0 * math.ceil(high / 5.0))


def _images(subjects: Sequence[Subject], shots: Sequence[Shot]) -> Images:
    return [{subject.name: subject.image(shot) for subject in subjects} for shot in shots]


def _measured(
    images: Images, shots: Sequence[Shot], settings: Settings
) -> dict[str, dict[str, Numbers]]:
    """The measures of each image, by shot and name."""
    return {
        shot.name: {name: measure(image, shot.truth, settings) for name, image in held.items()}
        for shot, held in zip(shots, images, strict=True)
    }


def _decibels(found: Numbers) -> str:
    return written(found["psnr"], 2, " dB")
