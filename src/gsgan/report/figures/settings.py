"""The named settings of the figures: sizes in print, and what is measured on the pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass

from gsgan.utils.errors import ConfigError

MOST_INCHES, MOST_DPI = 50, 2400


@dataclass(frozen=True)
class Settings:
    """How figures look and how the pictures in them are measured.

    Args:
        column: inches, width of a figure that stands in one column.
        page: inches, width of one that stands across the page.
        tallest: inches, the most height of one picture.
        font: points, of titles; numbers under pictures are one point smaller.
        dpi: of the PNG, and of what is pixels inside the PDF.
        margin: metres round the joints that are shown.
        canny_low, canny_high: Canny's hysteresis thresholds on 8-bit grey.
        canny_tolerance: pixels an edge may be off and still count as found.
        error_max: levels of 255 at the end of the error maps' scale; None takes the 99.5th
            percentile of the maps shown.
        sigmas: standard deviations at which a projected Gaussian's outline is drawn.
        detail: sides of the ablation's magnified box, as a share of the picture's.

    Raises:
        ConfigError: when a value is not a finite number above 0, or nothing readable fits.
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
        for name, value in vars(self).items():
            if name == "error_max" and value is None:
                continue
            least = 0 if name == "canny_tolerance" else None
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not number or not (0 < value < math.inf or value == least):
                raise ConfigError(f"settings.{name} must be a number above 0, got {value!r}")
        whole = isinstance(self.canny_tolerance, int) and isinstance(self.dpi, int)
        if not whole or self.detail > 1 or self.canny_low > self.canny_high:
            raise ConfigError(
                "settings: canny_tolerance and dpi must be whole numbers, detail at most 1 and "
                f"canny_low at most canny_high; got {self.canny_tolerance}, {self.dpi}, "
                f"{self.detail}, {self.canny_low} and {self.canny_high}"
            )
        if self.column < 1 or self.page < 2 or self.tallest < 0.3 or self.font > 20:
            raise ConfigError(
                "settings: nothing readable fits; column must be at least 1 inch, page 2, tallest "
                f"0.3 and font at most 20 points; got {self.column}, {self.page}, {self.tallest} "
                f"and {self.font}"
            )
        if max(self.column, self.page, self.tallest) > MOST_INCHES or self.dpi > MOST_DPI:
            raise ConfigError(
                f"settings: column, page and tallest must be at most {MOST_INCHES} inches and dpi "
                f"{MOST_DPI}, else a picture would not fit into memory; got {self.column}, "
                f"{self.page}, {self.tallest} and {self.dpi}"
            )
