"""Sizes in print, and images in rows and columns."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from gsgan.utils.images import to_bytes

# Width of a figure in one column and across the page, inches.
COLUMN_WIDTH = 3.5
PAGE_WIDTH = 7.16
TALLEST = 1.9  # inches, maximum height of a row of images, without its text
# points
FONT = 8.0
NOTE_FONT = 7.0
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
    """A figure with its caption and numbers."""

    figure: Figure
    caption: str  # whole sentences, Markdown
    # by image, panel and score; None if a score is not defined
    numbers: dict[str, Any]


@dataclass(frozen=True)
class Panel:
    """One image of a figure."""

    image: Tensor  # [1, 3, h, w] in [0, 1]
    note: str = ""  # below the image


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
    # The tallest image and the longest note determine the height of all rows.
    aspect = 0.0
    note_lines = 0
    for panel in chain(*panels):
        height, width = panel.image.shape[-2:]
        aspect = max(aspect, height / width)
        note_lines = max(note_lines, len(panel.note.splitlines()))

    # The size of the page follows from the images: none is stretched.
    rows = len(panels)
    columns = len(panels[0])
    page_width = COLUMN_WIDTH if columns <= 3 else PAGE_WIDTH
    tall = (
        min(page_width / columns * aspect, TALLEST) + note_lines * FONT * LINE
    )
    title_height = FONT * LINE if titles else 0
    figure = Figure(figsize=(page_width, rows * tall + title_height))
    # Nearly no space is left between images, which are drawn without ticks and frames.
    figure.set_layout_engine(
        "compressed", w_pad=0.01, h_pad=0.01, wspace=0.01, hspace=0.01
    )
    axes = figure.subplots(rows, columns, squeeze=False)
    for one, panel in zip(axes.flat, chain(*panels), strict=True):
        one.set(xticks=[], yticks=[])
        one.spines[:].set_visible(False)
        height, width = panel.image.shape[-2:]
        image = to_bytes(panel.image[0])
        one.imshow(image, interpolation="nearest", extent=(0, width, height, 0))
        one.set_xlabel(panel.note, size=NOTE_FONT, labelpad=2)

    # Names of runs may contain "$", which is no formula.
    plain: dict[str, Any] = {"parse_math": False, "size": FONT}
    for one, title in zip(axes[0], titles, strict=False):
        one.set_title(title, pad=2, **plain)
    for one, name in zip(axes[:, 0], names, strict=False):
        one.set_ylabel(name, labelpad=2, **plain)
    return figure, axes


def format_number(value: float | None, digits: int, unit: str = "") -> str:
    """A number with its unit, or n/a."""
    return "n/a" if value is None else f"{value:.{digits}f}{unit}"
