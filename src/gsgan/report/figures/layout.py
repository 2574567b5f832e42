"""Sizes in print, and images in rows and columns: what most figures are laid out with."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.text import Text
from torch import Tensor

from gsgan.utils.checks import between

GAP = 0.05  # inches between panels
EDGE = 0.02  # inches around the whole, so that no frame is cut off
LEAST_FONT = 3.0  # points
LINE = 1.4 / 72  # inches per line and point of font size
BAR_FOOT = 0.46  # inches that a colour bar needs in the foot
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
    measure, None where a measure is not defined."""

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
    """One image ``[1, 3, h, w]`` in [0, 1], or ``[h, w, …]`` as matplotlib takes it, or none, with
    a note below it, a frame, and further options of ``imshow``."""

    image: Tensor | np.ndarray | None
    note: str = ""
    framed: bool = False
    how: dict[str, Any] = field(default_factory=dict)


class Sheet:
    """Equal panels by row, the widest that fit into ``width`` inches, with titles above the
    columns, names left of the rows, and ``foot`` inches for a legend or colour bar.

    Text that does not fit is made smaller. ``axes`` are ``[rows, columns]``, in pixels of the
    images, pixel centres at +0.5.
    """

    def __init__(
        self,
        panels: Sequence[Sequence[Panel]],
        settings: Settings,
        *,
        width: float,
        titles: Sequence[str] = (),
        names: Sequence[str] = (),
        foot: float = 0.0,
    ) -> None:
        self.small, self.foot = settings.font - 1, foot
        shown = [[pixels(panel.image) for panel in row] for row in panels]
        sizes = [image.shape for row in shown for image in row if image is not None]
        aspect = max(shape[0] / shape[1] for shape in sizes)
        rows, columns, line = len(panels), len(panels[0]), settings.font * LINE
        left = EDGE + (line if names else 0.0)
        top = EDGE + line * max((1 + title.count("\n") for title in titles), default=0)
        notes = [panel.note for row in panels for panel in row if panel.note]
        below = max((1 + n.count("\n") for n in notes), default=0) * self.small * LINE + GAP
        gaps = left + EDGE + GAP * (columns - 1)
        panel_width = min((width - gaps) / columns, settings.tallest / aspect)
        panel_height = panel_width * aspect
        self.width = gaps + columns * panel_width
        self.height = top + rows * (panel_height + below) + foot
        self.figure = Figure(figsize=(self.width, self.height))
        self._renderer = FigureCanvasAgg(self.figure).get_renderer()
        places = {
            "left": left / self.width,
            "right": 1 - EDGE / self.width,
            "top": 1 - top / self.height,
            "bottom": (below + foot) / self.height,
            "wspace": GAP / panel_width,
            "hspace": below / panel_height,
        }
        self.axes = self.figure.subplots(rows, columns, squeeze=False, gridspec_kw=places)
        for i, row in enumerate(panels):
            for axes, panel, image in zip(self.axes[i], row, shown[i], strict=True):
                axes.set(xticks=[], yticks=[])
                axes.spines[:].set_visible(panel.framed)
                if image is not None:
                    extent = (0, image.shape[1], image.shape[0], 0)
                    axes.imshow(image, interpolation="nearest", extent=extent, **panel.how)
                self._fit([axes.set_xlabel(panel.note, size=self.small, labelpad=2)], panel_width)
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

    def bar(self, mappable: ScalarMappable, label: str, *, over: bool) -> None:
        """A colour bar in the foot; ``over``: there are values beyond its end."""
        wide = min(0.6, 3.0 / self.width)
        axes = self.figure.add_axes(
            ((1 - wide) / 2, (self.foot - 0.12) / self.height, wide, 0.08 / self.height)
        )
        end = "max" if over else "neither"
        self.figure.colorbar(mappable, cax=axes, orientation="horizontal", extend=end)
        axes.tick_params(labelsize=self.small, width=0.4, length=2, pad=1.5)
        axes.set_xlabel(label, fontsize=self.small, labelpad=2)

    def legend(self, colours: dict[str, str], columns: int) -> None:
        """Named colours in the foot."""
        patches = [Patch(facecolor=colour, label=name) for name, colour in colours.items()]
        self.figure.legend(
            handles=patches, loc="lower center", ncols=columns, frameon=False,
            fontsize=self.small, handlelength=1.0, columnspacing=1.0, borderpad=0.0,
            borderaxespad=0.0, labelspacing=0.35,
        )  # fmt: skip


def legend_foot(lines: int, settings: Settings) -> float:
    """Inches that a legend of that many lines needs in the foot."""
    return lines * (settings.font - 1) * LINE + 0.05


def pixels(image: Tensor | np.ndarray | None) -> np.ndarray | None:
    """``[h, w, 3]`` bytes of an image ``[1, 3, h, w]``; arrays as they are."""
    if not isinstance(image, Tensor):
        return image
    shown = (image[0].detach().cpu().clamp(0, 1) * 255).round().byte()
    return shown.permute(1, 2, 0).numpy()


def written(value: float | None, digits: int, unit: str = "") -> str:
    """A number with its unit, or n/a."""
    return "n/a" if value is None else f"{value:.{digits}f}{unit}"
