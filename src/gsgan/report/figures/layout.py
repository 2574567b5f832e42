"""Sizes in print, and images in rows and columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from torch import Tensor

from gsgan.utils.checks import between

GAP = 0.05  # inches between panels
EDGE = 0.02  # inches around the whole, so that no frame is cut off
LEAST_FONT = 3.0  # points
LINE = 1.4 / 72  # inches per line and point of font size
LIMITS = {  # of settings: what is readable and fits into memory
    "column": (1, 50), "page": (2, 50), "tallest": (0.3, 50), "font": (1, 20), "dpi": (1, 2400),
    "margin": (0, 1e6),
}  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """How figures look; `conf/report.yaml` has units.

    Raises:
        ConfigError: on a value outside `LIMITS`.
    """

    column: float = 3.5
    page: float = 7.16
    tallest: float = 1.9
    font: float = 8.0
    dpi: float = 300
    margin: float = 0.2

    def __post_init__(self) -> None:
        for name, limits in LIMITS.items():
            between(f"settings.{name}", getattr(self, name), *limits)


@dataclass(frozen=True)
class Drawing:
    """A figure, its caption (whole sentences, Markdown), and the numbers in it by image, panel and
    score, None where a score is not defined."""

    figure: Figure
    caption: str
    numbers: dict[str, Any]


class Unavailable(Exception):
    """What the runs lack for a figure; the other figures are still made."""


def style(settings: Settings) -> AbstractContextManager[None]:
    """Fonts and lines of every figure; text in the PDF stays text (TrueType)."""
    look: dict[Any, Any] = {"font.family": "DejaVu Sans", "font.size": settings.font}
    look |= {"pdf.fonttype": 42, "axes.linewidth": 0.5, "savefig.dpi": settings.dpi}
    return matplotlib.rc_context(look)


@dataclass(frozen=True)
class Panel:
    """One image ``[1, 3, h, w]`` in [0, 1], or ``[h, w]`` with options of ``imshow`` in ``look``; a
    note below it, and a frame."""

    image: Tensor | np.ndarray
    note: str = ""
    framed: bool = False
    look: Mapping[str, Any] = field(default_factory=dict)


class Sheet:
    """Equal panels by row, the widest that fit into a page (or a column, for at most three of
    them), with titles above the columns and names left of the rows.

    Text that does not fit is made smaller. ``axes`` are ``[rows, columns]``, in pixels of the
    images, pixel centres at +0.5.
    """

    def __init__(
        self,
        panels: Sequence[Sequence[Panel]],
        settings: Settings,
        *,
        titles: Sequence[str] = (),
        names: Sequence[str] = (),
    ) -> None:
        small = settings.font - 1
        shown = [[pixels(panel.image) for panel in row] for row in panels]
        aspect = max(image.shape[0] / image.shape[1] for row in shown for image in row)
        rows, columns, line = len(panels), len(panels[0]), settings.font * LINE
        width = settings.column if columns <= 3 else settings.page
        left = EDGE + (line if names else 0.0)
        top = EDGE + (line if titles else 0.0)
        notes = [panel.note for row in panels for panel in row if panel.note]
        below = max((1 + n.count("\n") for n in notes), default=0) * small * LINE + GAP
        gaps = left + EDGE + GAP * (columns - 1)
        panel_width = min((width - gaps) / columns, settings.tallest / aspect)
        panel_height = panel_width * aspect
        self.width = gaps + columns * panel_width
        height = top + rows * (panel_height + below)
        self.figure = Figure(figsize=(self.width, height))
        self._renderer = FigureCanvasAgg(self.figure).get_renderer()
        places = {
            "left": left / self.width,
            "right": 1 - EDGE / self.width,
            "top": 1 - top / height,
            "bottom": below / height,
            "wspace": GAP / panel_width,
            "hspace": below / panel_height,
        }
        self.axes = self.figure.subplots(rows, columns, squeeze=False, gridspec_kw=places)
        for i, row in enumerate(panels):
            for axes, panel, image in zip(self.axes[i], row, shown[i], strict=True):
                axes.set(xticks=[], yticks=[])
                axes.spines[:].set_visible(panel.framed)
                extent = (0, image.shape[1], image.shape[0], 0)
                axes.imshow(image, interpolation="nearest", extent=extent, **panel.look)
                self._fit([axes.set_xlabel(panel.note, size=small, labelpad=2)], panel_width)
        plain: dict[str, Any] = {"parse_math": False, "size": settings.font}  # "$x" is no formula
        heads = [a.set_title(t, pad=2, **plain) for a, t in zip(self.axes[0], titles, strict=False)]
        self._fit(heads, panel_width)
        for axes, name in zip(self.axes[:, 0], names, strict=False):
            self._fit([axes.set_ylabel(name, labelpad=2, **plain)], panel_height)

    def _fit(self, texts: Sequence[Text], room: float) -> None:
        """Gives texts the largest common size at which none is longer than ``room`` inches."""

        def long(text: Text) -> bool:
            box = text.get_window_extent(self._renderer)
            return max(box.width, box.height) / self.figure.dpi > room

        while any(map(long, texts)) and (size := float(texts[0].get_fontsize())) > LEAST_FONT:
            for text in texts:
                text.set_fontsize(size - 0.25)


def pixels(image: Tensor | np.ndarray) -> np.ndarray:
    """``[h, w, 3]`` bytes of an image ``[1, 3, h, w]``; arrays as they are."""
    if not isinstance(image, Tensor):
        return image
    shown = (image[0].detach().cpu().clamp(0, 1) * 255).round().byte()
    return shown.permute(1, 2, 0).numpy()


def written(value: float | None, digits: int, unit: str = "") -> str:
    """A number with its unit, or n/a."""
    return "n/a" if value is None else f"{value:.{digits}f}{unit}"
