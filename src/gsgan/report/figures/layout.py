"""Sizes in print, and images in rows and columns."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from gsgan.utils.images import to_bytes

# inches, width of a figure in one column and across the page
COLUMN = 3.5
PAGE = 7.16
TALLEST = 1.9  # inches, maximum height of a row of images, without its text
# points
FONT = 8.0
SMALL = 7.0
LINE = 1.4 / 72  # inches per line and point of font size
# Text in the PDF stays text (TrueType).
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": FONT,
    "pdf.fonttype": 42,
    "axes.linewidth": 0.5,
    "savefig.dpi": 300,
}


@dataclass(frozen=True)
class Drawing:
    """A figure, its caption (whole sentences, Markdown), and the numbers in it by image, panel and
    score, None where a score is not defined."""

    figure: Figure
    caption: str
    numbers: dict[str, Any]


@dataclass(frozen=True)
class Panel:
    """One image ``[1, 3, h, w]`` in [0, 1], and a note below it."""

    image: Tensor
    note: str = ""


def draw_panels(
    panels: Sequence[Sequence[Panel]],
    *,
    titles: Sequence[str] = (),
    names: Sequence[str] = (),
) -> tuple[Figure, np.ndarray]:
    """Equal panels by row, with titles above the columns and names left of the rows.

    The figure is as wide as a page, or as a column with at most three panels in a row.

    Returns:
        The figure, and its axes ``[rows, columns]``, in pixels of the images, pixel centres at
        +0.5.
    """
    shown = [[to_bytes(panel.image[0]) for panel in row] for row in panels]
    aspect = max(image.shape[0] / image.shape[1] for row in shown for image in row)
    rows = len(panels)
    columns = len(panels[0])
    width = COLUMN if columns <= 3 else PAGE
    notes = max(
        1 + panel.note.count("\n") if panel.note else 0
        for row in panels
        for panel in row
    )
    tall = min(width / columns * aspect, TALLEST) + notes * FONT * LINE
    height = rows * tall + (FONT * LINE if titles else 0)
    figure = Figure(figsize=(width, height))
    figure.set_layout_engine(
        "compressed", w_pad=0.01, h_pad=0.01, wspace=0.01, hspace=0.01
    )
    axes = figure.subplots(rows, columns, squeeze=False)
    for i, row in enumerate(panels):
        for one, panel, image in zip(axes[i], row, shown[i], strict=True):
            one.set(xticks=[], yticks=[])
            one.spines[:].set_visible(False)
            extent = (0, image.shape[1], image.shape[0], 0)
            one.imshow(image, interpolation="nearest", extent=extent)
            one.set_xlabel(panel.note, size=SMALL, labelpad=2)
    plain: dict[str, Any] = {"parse_math": False, "size": FONT}  # "$x" is no formula
    for one, title in zip(axes[0], titles, strict=False):
        one.set_title(title, pad=2, **plain)
    for one, name in zip(axes[:, 0], names, strict=False):
        one.set_ylabel(name, labelpad=2, **plain)
    return figure, axes


def written(value: float | None, digits: int, unit: str = "") -> str:
    """A number with its unit, or n/a."""
    return "n/a" if value is None else f"{value:.{digits}f}{unit}"
