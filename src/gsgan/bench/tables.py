"""Tables as Markdown and CSV, and the marked blocks of a page that hold them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from gsgan.utils import pages
from gsgan.utils.pages import markdown

__all__ = ["NOTHING", "check_block", "csv_text", "fill_block", "markdown", "number"]

NOTHING = "–"  # what was not measured


def csv_text(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table as comma-separated values; None is empty."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return stream.getvalue()


def number(value: float | None, digits: int = 3) -> str:
    """``digits`` significant ones, an exponent only where it helps; a dash for None."""
    if value is None:
        return NOTHING
    if value == 0 or 1e-2 <= abs(value) < 10**digits:
        return f"{value:#.{digits}g}".rstrip(".")
    return f"{value:.0f}" if abs(value) >= 1 else f"{value:.{digits - 1}e}"


def fill_block(page: Path, name: str, text: str) -> None:
    """Puts text between ``<!-- bench:name -->`` and the ``<!-- end -->`` that follows it.

    Raises:
        ConfigError: when the page is missing or has no such block.
    """
    pages.fill_block(page, *_markers(name), text, key="docs")


def check_block(page: Path, name: str) -> None:
    """Whether ``fill_block`` will find its block, before anything long begins.

    Raises:
        ConfigError: as ``fill_block`` does.
    """
    pages.check_block(page, *_markers(name), key="docs")


def _markers(name: str) -> tuple[str, str]:
    return f"<!-- bench:{name} -->", "<!-- end -->"
