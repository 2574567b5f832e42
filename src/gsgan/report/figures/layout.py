"""Sizes in print, and panels in rows and columns: what every figure of images is laid out with."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.text import Text
from torch import Tensor

from gsgan.utils.errors import ConfigError

GAP = 0.05  # inches between panels
EDGE = 0.02  # inches around the whole, so that no frame is cut off
LEAST_FONT = 5.0  # points: smaller is not readable in print
LINE = 1.4 / 72  # inches per line and point of font size
BAR_FOOT = 0.46  # inches that a colour bar needs in the foot
LIMITS = {  # of every setting but error_max
    "column": (1, 50), "page": (2, 50), "tallest": (0.3, 50), "font": (1, 20), "dpi": (1, 2400),
    "margin": (1e-3, 1e3), "canny_low": (1e-3, 1e5), "canny_high": (1e-3, 1e5),
    "canny_tolerance": (0, 100), "sigmas": (1e-3, 100), "detail": (1e-3, 1),
}  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """How figures look and how the images in them are measured.

    Args:
        column, page: inches, width of a figure in one column and across the page.
        tallest: inches, maximum height of one image.
        font: points, of titles; numbers below images are one point smaller.
        dpi: of the PNG, and of raster parts of the PDF.
        margin: metres around the joints that are shown.
        canny_low, canny_high: Canny's hysteresis thresholds on 8-bit grey.
        canny_tolerance: pixels an edge may be off and still count as found.
        error_max: levels of 255 at the end of the error scale; None takes the 99.5th percentile.
        sigmas: standard deviations at which projected Gaussians are outlined.
        detail: sides of the ablation's magnified box, as a share of the image's.

    Raises:
        ConfigError: on a value outside `LIMITS`.
    """

    column: float = 3.5
    page: float = 7.16
    tallest: float = 1.9
    font: float = 8.0
    dpi: int = 300
    margin: float = 0.2
    canny_low: float = 100.0
    canny_high: float = 200.0
    canny_tolerance: int = 1
    error_max: float | None = None
    sigmas: float = 1.0
    detail: float = 0.35

    def __post_init__(self) -> None:
        scale = {} if self.error_max is None else {"error_max": (1e-3, 255)}
        for name, (low, high) in (LIMITS | scale).items():
            value, kind = getattr(self, name), int if name in ("dpi", "canny_tolerance") else float
            right = isinstance(value, int | kind) and not isinstance(value, bool)
            if not right or not low <= value <= high:
                whole = "a whole number" if kind is int else "a number"
                raise ConfigError(
                    f"settings.{name} must be {whole} from {low:g} to {high:g}, got {value!r}"
                )
        if self.canny_low > self.canny_high:
            raise ConfigError("settings.canny_low must be at most settings.canny_high")


@dataclass(frozen=True)
class Drawing:
    """A figure with its caption and numbers.

    Args:
        figure: of matplotlib.
        caption: whole sentences, Markdown: what is shown and how its numbers were measured.
        numbers: ``{image: {panel: {measure: value}}}``, None where a measure is not defined.
    """

    figure: Figure
    caption: str
    numbers: dict[str, Any]


class Unavailable(Exception):
    """What the runs lack for a figure; the other figures are still made."""


@contextmanager
def style(settings: Settings) -> Iterator[None]:
    """Fonts and lines of every figure; text in the PDF stays text (TrueType)."""
    look: dict[Any, Any] = {
        "font.family": "DejaVu Sans",
        "font.size": settings.font,
        "pdf.fonttype": 42,
        "axes.linewidth": 0.5,
        "savefig.dpi": settings.dpi,
    }
    with matplotlib.rc_context(look):
        yield


class Panels:
    """A figure of equal panels, a title above each column and a note below each panel.

    The widest figure that fits ``width`` with no panel higher than ``settings.tallest``. Text that
    is wider than its panel is made smaller, and then cut off with an ellipsis.

    Args:
        rows, columns: of panels.
        settings: sizes.
        aspect: a panel's height over its width.
        width: inches, at most.
        titles: above the columns, of one line or more.
        names: at the left of the rows.
        notes: lines of text below each panel.
        foot: inches kept at the bottom for a legend or colour bar.
    """

    def __init__(
        self,
        rows: int,
        columns: int,
        settings: Settings,
        *,
        aspect: float,
        width: float,
        titles: Sequence[str] = (),
        names: Sequence[str] = (),
        notes: int = 1,
        foot: float = 0.0,
    ) -> None:
        self.small, self.foot = settings.font - 1, foot
        line = settings.font * LINE
        left = EDGE + (line if names else 0.0)
        top = EDGE + line * max((1 + title.count("\n") for title in titles), default=0)
        below = notes * self.small * LINE + GAP
        gaps = left + EDGE + GAP * (columns - 1)
        self.panel_width = min((width - gaps) / columns, settings.tallest / aspect)
        panel_height = self.panel_width * aspect
        self.width = gaps + columns * self.panel_width
        self.height = top + rows * (panel_height + below) + foot
        self.figure = Figure(figsize=(self.width, self.height))
        self._renderer = FigureCanvasAgg(self.figure).get_renderer()
        self.axes = self.figure.subplots(
            rows, columns, squeeze=False,
            gridspec_kw={
                "left": left / self.width, "right": 1 - EDGE / self.width,
                "top": 1 - top / self.height, "bottom": (below + foot) / self.height,
                "wspace": GAP / self.panel_width, "hspace": below / panel_height,
            },
        )  # fmt: skip
        for axes in self.axes.flat:
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
        plain: dict[str, Any] = {"parse_math": False, "size": settings.font}  # "$x" is no formula
        heads = [a.set_title(t, pad=2, **plain) for a, t in zip(self.axes[0], titles, strict=False)]
        self._fit(heads, self.panel_width)
        for axes, name in zip(self.axes[:, 0], names, strict=False):
            self._fit([axes.set_ylabel(name, labelpad=2, **plain)], panel_height)

    def _fit(self, texts: Sequence[Text], room: float) -> None:
        """Gives texts the largest common size at which none is longer than ``room`` inches."""

        def long(text: Text) -> bool:
            box = text.get_window_extent(self._renderer)
            return max(box.width, box.height) / self.figure.dpi > room

        while any(map(long, texts)) and (size := float(texts[0].get_fontsize())) > LEAST_FONT:
            for text in texts:
                text.set_fontsize(max(LEAST_FONT, size - 0.25))
        for text in texts:
            lines = text.get_text().split("\n")
            most = max(map(len, lines))
            while long(text) and most > 1:
                most -= 1
                text.set_text("\n".join(s if len(s) <= most else f"{s[:most]}…" for s in lines))

    def panel(self, row: int, column: int, note: str = "", *, framed: bool = False) -> Axes:
        """A panel, with the note below it."""
        axes: Axes = self.axes[row, column]
        axes.spines[:].set_visible(framed)
        self._fit([axes.set_xlabel(note, size=self.small, labelpad=2)], self.panel_width)
        return axes

    def show(
        self,
        row: int,
        column: int,
        image: Tensor | np.ndarray,
        note: str = "",
        *,
        framed: bool = False,
        **how: Any,
    ) -> Axes:
        """A panel with an image: ``[1, 3, h, w]`` in [0, 1], or an array as matplotlib takes it."""
        axes = self.panel(row, column, note, framed=framed)
        shown = pixels(image) if isinstance(image, Tensor) else image
        height, width = shown.shape[:2]
        # pixel centres at +0.5, as in the cameras
        axes.imshow(shown, interpolation="nearest", extent=(0, width, height, 0), **how)
        return axes

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
        patches = [Patch(facecolor=c, edgecolor="#555555", label=name, lw=0.4)
                   for name, c in colours.items()]  # fmt: skip
        self.figure.legend(
            handles=patches, loc="lower center", ncols=columns, frameon=False,
            fontsize=self.small, handlelength=1.0, handleheight=0.8, columnspacing=1.0,
            handletextpad=0.4, borderaxespad=0.0, borderpad=0.0, labelspacing=0.35,
        )  # fmt: skip


def legend_foot(lines: int, settings: Settings) -> float:
    """Inches that a legend of so many lines needs in the foot."""
    return lines * (settings.font - 1) * LINE + 0.05


def pixels(image: Tensor) -> np.ndarray:
    """``[h, w, 3]`` bytes of an image ``[1, 3, h, w]``."""
    shown = (image[0].detach().cpu().clamp(0, 1) * 255).round().byte()
    return shown.permute(1, 2, 0).numpy()


def written(value: float | None, digits: int, unit: str = "") -> str:
    """A number with its unit, or n/a."""
    return "n/a" if value is None or not math.isfinite(value) else f"{value:.{digits}f}{unit}"
