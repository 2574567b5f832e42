"""Figures of images side by side, and of training: all but densify and segmentation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgb
from matplotlib.figure import Figure
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
from gsgan.report.figures.subjects import Numbers, Shot, Subject, finite, measure
from gsgan.report.training_curve import curve
from gsgan.utils.errors import DataError
from gsgan.utils.palette import BLACK, COLOURS, MARKERS, SKY, VERMILLION

FOUND, MISSED, INVENTED = BLACK, SKY, VERMILLION  # edges
NEAR = 1  # pixels an edge may be off, as in edge F1
ERROR_COLOURS = "magma_r"  # pale is no error; even steps of lightness, in grey print too
DETAIL = 0.35  # sides of the ablation's box, as a share of the image's
STEP_ONE = "Step I's colour"
Images = list[dict[str, Tensor]]  # per shot, by name


def teaser(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Skeletons above the first run's images, each with its own camera.

    Source: the paper's teaser.
    """
    subject = subjects[0]
    images, numbers = _measured([subject], shots)
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
    images, numbers = _measured(subjects, shots)
    panels = [[Panel(shot.truth) for shot in shots]]
    for name in images[0]:
        notes = [_decibels(numbers[shot.name][name]) for shot in shots]
        panels.append([Panel(x[name], note) for x, note in zip(images, notes, strict=True)])
    titles, names = [f"frame {shot.item[1]}" for shot in shots], ["truth", *images[0]]
    sheet = Sheet(panels, settings, width=settings.page, titles=titles, names=names)
    caption = "One camera over time: the ground truth and each run's images, with PSNR."
    return Drawing(sheet.figure, caption, numbers)


def comparison(
    subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings, *, detail: bool = False
) -> Drawing:
    """A row per shot: the ground truth and each run's image, with PSNR and edge F1.

    With ``detail`` a second row magnifies the box in which the runs differ most: where the variance
    between their images is largest. The ground truth has no part in it, so it favours no run.

    Source: the paper's comparison figure; with ``detail`` its ablation triplet (full, w/o GCN,
    w/o S).
    """
    images, numbers = _measured(subjects, shots)
    panels: list[list[Panel]] = []
    boxes = [most_disputed(torch.cat(list(held.values())), DETAIL) for held in images]
    for shot, held, box in zip(shots, images, boxes, strict=True):
        above, below = [Panel(shot.truth)], [Panel(shot.truth[..., *box])]
        for name, image in held.items():
            found = numbers[shot.name][name]
            above.append(Panel(image, f"{_decibels(found)}\nF1 {written(found['edge_f1'], 3)}"))
            if detail:
                found["psnr_detail"] = finite(psnr(image[..., *box], shot.truth[..., *box]))
                below.append(Panel(image[..., *box], written(found["psnr_detail"], 2, " dB")))
        panels += [above, below] if detail else [above]
    sheet = Sheet(panels, settings, width=settings.page, titles=["truth", *images[0]])
    caption = "The ground truth and each run's image, with PSNR and the F1 of Canny edges"
    if not detail:
        return Drawing(sheet.figure, f"{caption}.", numbers)
    for i, (rows, columns) in enumerate(boxes):
        size = columns.stop - columns.start, rows.stop - rows.start
        for whole, magnified in zip(sheet.axes[2 * i], sheet.axes[2 * i + 1], strict=True):
            frame = Rectangle((columns.start, rows.start), *size, fill=False, ec=VERMILLION, lw=0.8)
            whole.add_patch(frame)
            magnified.spines[:].set(visible=True, color=VERMILLION, linewidth=1.6)
    caption += (
        "; below, magnified, the box in which the runs' images differ most from each other, with "
        "PSNR in the box."
    )
    return Drawing(sheet.figure, caption, numbers)


def most_disputed(images: Tensor, share: float) -> tuple[slice, slice]:
    """Rows and columns where images ``[n, 3, h, w]`` of one scene differ most from each other.

    The box's sides are a ``share`` of the images'.
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
    images, numbers = _measured(subjects, shots, splatting=True)
    panels = []
    for shot, held in zip(shots, images, strict=True):
        truth = canny_edges(shot.truth[0])
        panels.append([Panel(paint_edges(truth, truth), f"{truth.sum()} px", framed=True)])
        for name, image in held.items():
            found = numbers[shot.name][name]
            note = f"ratio {written(found['edge_ratio'], 2)}\nF1 {written(found['edge_f1'], 3)}"
            panels[-1].append(Panel(paint_edges(canny_edges(image[0]), truth), note, framed=True))
    titles, foot = ["truth", *images[0]], legend_foot(1, settings)
    width = settings.column if len(titles) <= 3 else settings.page
    sheet = Sheet(panels, settings, width=width, titles=titles, foot=foot)
    sheet.legend({"edge": FOUND, "missing": MISSED, "not in the truth": INVENTED}, columns=3)
    caption = (
        "Canny edges (thresholds 100 and 200 on 8-bit grey); below the ground truth, their number "
        f"of pixels. Ratio: edge pixels over the ground truth's. F1: of edges, {NEAR} px off "
        "allowed."
    )
    return Drawing(sheet.figure, caption, numbers)


def paint_edges(edges: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Edges ``[h, w]`` as an RGB image ``[h, w, 3]`` of bytes on white.

    As in edge F1, an edge is found where the other image has one within `NEAR` pixels.
    """
    kernel = np.ones((2 * NEAR + 1, 2 * NEAR + 1), np.uint8)
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
    images, numbers = _measured(subjects, shots, splatting=True)
    names = list(images[0])
    if len(names) < 2:
        raise Unavailable(f"{names[0]} has no second image; add a run as compare=[<folder>]")
    maps = [
        {name: error_levels(image, shot.truth) for name, image in held.items()}
        for shot, held in zip(shots, images, strict=True)
    ]
    every = torch.cat([error.flatten() for held in maps for error in held.values()])
    top = scale_end(every)
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
    return (image - truth).abs().mean(dim=1)[0].double() * 255


def scale_end(values: Tensor) -> float:
    """The 99.5th percentile, rounded up to five levels."""
    high = float(np.percentile(values.numpy(), 99.5, method="inverted_cdf"))
    return max(5.0, 5.0 * math.ceil(high / 5.0))


def training(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """PSNR of the watched images against minutes, a line per run, Step I's colour dashed.

    Raises:
        Unavailable: when a run has no log that can be read.
    """
    figure = Figure((settings.column, 0.75 * settings.column), layout="constrained")
    axes = figure.add_subplot()
    shown, solid, numbers = [], [], {}
    for k, subject in enumerate(subjects):
        try:
            found = curve(subject.name, subject.run.folder)
        except DataError as error:
            raise Unavailable(str(error)) from error
        if found is None or found.seconds[-1] <= 0:
            raise Unavailable(
                f"{subject.run.folder} has no log of two validations and their time (logger=csv "
                "writes one)"
            )
        parts = (found.seconds, found.psnr, found.colour)
        numbers[subject.name] = dict(zip(("seconds", "psnr", "psnr_colour"), parts, strict=True))
        minutes = [second / 60 for second in found.seconds]
        look: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "lw": 1.0}
        marker = MARKERS[k % len(MARKERS)]
        solid += axes.plot(minutes, found.psnr, marker=marker, markersize=3, **look)
        lines = [found.psnr]
        if subject.avatar.generator is not None and found.colour:
            axes.plot(minutes, found.colour, ls="--", **look)
            lines.append(found.colour)
        # without the untrained start, many dB below the rest
        shown += [v for line in lines for m, v in zip(minutes, line, strict=True) if m > 0]
    small = settings.font - 1
    axes.set_xlabel("minutes of training", fontsize=small)
    axes.set_ylabel("PSNR of watched images, dB", fontsize=small)
    axes.tick_params(labelsize=small)
    room = 0.08 * max(max(shown) - min(shown), 0.1)
    axes.set(xlim=(0, None), ylim=(min(shown) - room, max(shown) + room))
    axes.grid(visible=True, alpha=0.25)
    legend = axes.legend(solid, [""] * len(solid), fontsize=small, frameon=False, loc=4)
    for text, name in zip(legend.get_texts(), numbers, strict=True):
        text.set(text=name, parse_math=False)
    caption = (
        f"PSNR of the {len(shots)} held-out images that were watched while training, against "
        "minutes of training; dashed, Step I's colour of the same model."
    )
    return Drawing(figure, caption, {"training": numbers})


def _measured(
    subjects: Sequence[Subject], shots: Sequence[Shot], *, splatting: bool = False
) -> tuple[Images, dict[str, dict[str, Numbers]]]:
    """Images of each shot by run, and their measures.

    Args:
        splatting: add Step I's colour of the first run, unless a run is of splatting alone.
    """
    images: Images = []
    for shot in shots:
        images.append({subject.name: subject.image(shot) for subject in subjects})
        colour = subjects[0].colour(shot)
        if splatting and colour is not None and all(s.run.name != "splat_only" for s in subjects):
            images[-1][STEP_ONE] = colour
    return images, {
        shot.name: {name: measure(image, shot.truth) for name, image in held.items()}
        for shot, held in zip(shots, images, strict=True)
    }


def _decibels(found: Numbers) -> str:
    return written(found["psnr"], 2, " dB")
