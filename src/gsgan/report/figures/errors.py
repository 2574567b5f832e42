"""Error heat maps: the final picture against splatting alone, on one scale."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from torch import Tensor

from gsgan.report.figures.layout import BAR_FOOT, Drawing, Grid, Unavailable, aspect_of, extent
from gsgan.report.figures.measures import decibels, measure, rivals, where_from
from gsgan.report.figures.settings import Settings
from gsgan.report.figures.shots import Shot
from gsgan.report.figures.subjects import Subject

COLOURS = "magma_r"  # pale is no error; even steps of lightness, in grey print too
LEVELS = 255.0


def draw(subjects: Sequence[Subject], shots: Sequence[Shot], settings: Settings) -> Drawing:
    """Truth, pictures, then their absolute errors; one scale for all, the mean under each map.

    Raises:
        Unavailable: when there is nothing to compare with.

    Source: the paper's error maps of GaussianGAN and splatting alone.
    """
    pictures = [rivals(subjects, shot) for shot in shots]
    names = list(pictures[0])
    if len(names) < 2:
        raise Unavailable(
            f"{names[0]} has no second picture to compare with; give another run as "
            "compare=[<folder>]"
        )
    errors = [
        {name: error_levels(picture, shot.truth) for name, picture in drawn.items()}
        for shot, drawn in zip(shots, pictures, strict=True)
    ]
    top = settings.error_max or _scale([error for row in errors for error in row.values()])
    scale = Normalize(0, top)
    grid = Grid(
        len(shots),
        1 + 2 * len(names),
        aspect_of([shot.truth for shot in shots]),
        settings,
        width=settings.page,
        titles=["truth", *(f"{name}\n{what}" for what in ("picture", "error") for name in names)],
        foot=BAR_FOOT,
    )
    numbers: dict[str, dict[str, dict[str, float | None]]] = {}
    for row, (shot, drawn) in enumerate(zip(shots, pictures, strict=True)):
        grid.picture(row, 0, shot.truth)
        numbers[shot.name] = {}
        for column, (name, picture) in enumerate(drawn.items(), start=1):
            error = errors[row][name]
            found = measure(picture, shot.truth, settings)
            found["error_mean"] = float(error.mean())
            numbers[shot.name][name] = found
            grid.picture(row, column, picture, decibels(found))
            axes = grid.panel(row, column + len(names), f"mean {error.mean():.2f}", framed=True)
            axes.imshow(
                error.numpy(), cmap=COLOURS, norm=scale, interpolation="nearest",
                extent=extent(picture),
            )  # fmt: skip
    over = any(bool((error > top).any()) for row in errors for error in row.values())
    grid.bar(
        ScalarMappable(scale, COLOURS),
        "absolute error, mean of R, G and B (levels of 255)",
        over=over,
    )
    caption = (
        "Absolute error of each pixel, mean over the three channels, in levels of 255; one scale "
        f"for all maps, which ends at {top:g}. The mean over the window stands under each map. "
        + where_from(shots, settings.margin)
    )
    return Drawing(grid.figure, caption, numbers)


def error_levels(picture: Tensor, truth: Tensor) -> Tensor:
    """``[h, w]``: |picture - truth| of ``[1, 3, h, w]``, mean over channels, levels of 255."""
    return (picture - truth).abs().mean(dim=1)[0].double() * LEVELS


def _scale(errors: Sequence[Tensor]) -> float:
    """The end of the scale: the 99.5th percentile of all errors, up to the next five levels."""
    every = torch.cat([error.flatten() for error in errors]).numpy()
    high = float(sorted(every)[math.ceil(0.995 * len(every)) - 1])
    return max(5.0, 5.0 * math.ceil(high / 5.0))
