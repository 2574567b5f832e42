"""Panels in rows and columns, laid out in inches: what every figure of pictures stands on."""

from __future__ import annotations

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

from gsgan.report.figures.settings import Settings

GAP = 0.05  # inches between panels
EDGE = 0.02  # inches round the whole, so that no frame is cut
LEAST_FONT = 5.0  # points: smaller is not readable in print
POINT = 1 / 72  # inches
LINE = 1.35  # height of a line of text over its font size


@dataclass(frozen=True)
class Drawing:
    """A figure with what is to be said about it.

    Args:
        figure: of matplotlib.
        caption: whole sentences, Markdown: what is shown and how its numbers were measured.
        numbers: ``{picture: {panel: {measure: value}}}``, as they stand in the figure; None where
            a measure is not defined.
    """

    figure: Figure
    caption: str
    numbers: dict[str, Any]


class Unavailable(Exception):
    """What the runs given lack for a figure, as a sentence; the other figures are still made."""


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


class Grid:
    """A figure of equal panels, a title over each column and a note under each panel.

    The widest figure that fits ``width`` with no panel higher than ``settings.tallest``. Text that
    is wider than its panel is made smaller, and cut off with an ellipsis where that is not enough.

    Args:
        rows, columns: of panels.
        aspect: a panel's height over its width.
        settings: sizes.
        width: inches, at most.
        titles: over the columns, of one line or more; none leaves no room for them.
        names: at the left of the rows; none leaves no room for them.
        notes: lines of text under the panels of each row, or of all.
        foot: inches kept at the bottom for a legend or colour bar.
    """

    def __init__(
        self,
        rows: int,
        columns: int,
        aspect: float,
        settings: Settings,
        *,
        width: float,
        titles: Sequence[str] = (),
        names: Sequence[str] = (),
        notes: int | Sequence[int] = 1,
        foot: float = 0.0,
    ) -> None:
        self.settings = settings
        self.small = settings.font - 1
        self.foot = foot
        line = settings.font * LINE * POINT
        self.left = EDGE + (line if names else 0.0)
        top = EDGE + line * max((1 + title.count("\n") for title in titles), default=0)
        gaps = GAP * (columns - 1)
        self.panel_width = (width - self.left - EDGE - gaps) / columns
        self.panel_width = min(self.panel_width, settings.tallest / aspect)
        self.panel_height = self.panel_width * aspect
        self.width = self.left + columns * self.panel_width + gaps + EDGE
        lines = [notes] * rows if isinstance(notes, int) else list(notes)
        steps = [self.panel_height + n * self.small * LINE * POINT + GAP for n in lines]
        self.tops = [top + sum(steps[:row]) for row in range(rows)]
        self.height = top + sum(steps) + foot
        self.figure = Figure(figsize=(self.width, self.height))
        self._renderer = FigureCanvasAgg(self.figure).get_renderer()
        lowest = max((title.count("\n") for title in titles), default=0)
        heads = []
        for column, title in enumerate(titles):  # those of fewer lines stand lower
            padded = "\n" * (lowest - title.count("\n")) + title
            heads += self._lines(column, EDGE, padded, settings.font)
        for head in heads:
            head.set_fontsize(min(float(other.get_fontsize()) for other in heads))
        for row, name in enumerate(names):
            middle = self.tops[row] + self.panel_height / 2
            x = EDGE + line * 0.4
            self._text(
                x, middle, name, self.panel_height, size=settings.font, va="center", rotation=90
            )

    def _lines(self, column: int, top: float, text: str, size: float) -> list[Text]:
        """Lines over or under a column's panels, beginning ``top`` inches from the top edge."""
        x = self.left + column * (self.panel_width + GAP) + self.panel_width / 2
        made = []
        for number, line in enumerate(text.split("\n")):
            baseline = top + (number * LINE + 1) * size * POINT
            made.append(self._text(x, baseline, line, self.panel_width, va="baseline", size=size))
        return made

    def _text(self, x: float, y: float, text: str, room: float, *, size: float, **how: Any) -> Text:
        """Text at inches from the left and top edges, centred, in ``room`` inches of length."""
        place = (x / self.width, 1 - y / self.height)
        # a name with a dollar sign is no formula
        shown = self.figure.text(*place, text, ha="center", size=size, parse_math=False, **how)

        def length() -> float:
            box = shown.get_window_extent(self._renderer)
            return max(box.width, box.height) / self.figure.dpi

        while length() > room and size > LEAST_FONT:
            size = max(LEAST_FONT, size - 0.25)
            shown.set_fontsize(size)
        while len(text) > 2 and length() > room:
            text = text[:-1]
            shown.set_text(f"{text}…")
        return shown

    def panel(self, row: int, column: int, note: str = "", *, framed: bool = False) -> Axes:
        """The axes of a panel, without ticks, and the note under it."""
        x, y = self.left + column * (self.panel_width + GAP), self.tops[row]
        size = (self.panel_width / self.width, self.panel_height / self.height)
        place = (x / self.width, (self.height - y - self.panel_height) / self.height)
        axes = self.figure.add_axes((*place, *size))
        axes.set_xticks([])
        axes.set_yticks([])
        if not framed:
            axes.set_axis_off()
        self._lines(column, y + self.panel_height + 0.02, note, self.small)
        return axes

    def picture(
        self, row: int, column: int, picture: Tensor, note: str = "", *, framed: bool = False
    ) -> Axes:
        """A panel with a picture ``[1, 3, h, w]`` in [0, 1]."""
        axes = self.panel(row, column, note, framed=framed)
        axes.imshow(pixels(picture), interpolation="nearest", extent=extent(picture))
        return axes

    def bar(self, mappable: ScalarMappable, label: str, *, over: bool) -> None:
        """A colour bar across the middle of the foot; ``over`` points it where values go beyond."""
        wide = min(0.6 * self.width, 3.0)
        at = ((self.width - wide) / 2, self.foot - 0.12, wide, 0.08)
        axes = self.figure.add_axes(
            (at[0] / self.width, at[1] / self.height, at[2] / self.width, at[3] / self.height)
        )
        bar = self.figure.colorbar(
            mappable, cax=axes, orientation="horizontal", extend="max" if over else "neither"
        )
        bar.outline.set_linewidth(0.4)  # type: ignore[operator]
        axes.tick_params(labelsize=self.small, width=0.4, length=2, pad=1.5)
        bar.set_label(label, fontsize=self.small, labelpad=2)

    def legend(self, colours: dict[str, str], columns: int) -> None:
        """Named colours across the foot."""
        patches = [
            Patch(facecolor=c, edgecolor="#555555", linewidth=0.4, label=name)
            for name, c in colours.items()
        ]
        self.figure.legend(
            handles=patches, loc="lower center", ncols=columns, frameon=False,
            fontsize=self.small, handlelength=1.0, handleheight=0.8, columnspacing=1.0,
            handletextpad=0.4, borderaxespad=0.0, borderpad=0.0, labelspacing=0.35,
        )  # fmt: skip


def foot_lines(lines: int, settings: Settings) -> float:
    """Inches that so many lines of small text need in the foot."""
    return lines * (settings.font - 1) * 1.45 * POINT + 0.05


BAR_FOOT = 0.46  # inches that a colour bar needs in the foot


def pixels(picture: Tensor) -> np.ndarray:
    """``[h, w, 3]`` bytes of a picture ``[1, 3, h, w]``."""
    shown = (picture[0].detach().cpu().clamp(0, 1) * 255).round().byte()
    return shown.permute(1, 2, 0).numpy()


def extent(picture: Tensor) -> tuple[float, float, float, float]:
    """Places pixel centres at +0.5, as cameras have them: left, right, bottom, top."""
    height, width = picture.shape[-2:]
    return 0.0, float(width), float(height), 0.0


def aspect_of(pictures: Sequence[Tensor]) -> float:
    """The highest of the pictures' heights over their widths."""
    return max(picture.shape[-2] / picture.shape[-1] for picture in pictures)
