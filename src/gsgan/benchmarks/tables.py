"""Tables as Markdown and CSV, and the marked blocks of a page that hold them."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from gsgan.errors import ConfigError
from gsgan.files import write_atomically

NOTHING = "–"  # what was not measured


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; bars within cells are escaped."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(_cell(c) for c in line) + " |" for line in lines)


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
    head, tail = _around(page, name)
    write_atomically(page, f"{head}\n\n{text.strip()}\n\n{tail}")


def check_block(page: Path, name: str) -> None:
    """Whether ``fill_block`` will find its block, before anything long begins.

    Raises:
        ConfigError: as ``fill_block`` does.
    """
    _around(page, name)


def _around(page: Path, name: str) -> tuple[str, str]:
    """A page up to the start of a block, and from its end."""
    if not page.is_file():
        raise ConfigError(f"docs={page}: no such page; give a Markdown file or docs=null")
    start, end = f"<!-- bench:{name} -->", "<!-- end -->"
    head, found, rest = page.read_text().partition(start)
    _, closed, tail = rest.partition(end)
    if not found or not closed:
        raise ConfigError(f"docs={page}: expected a block {start} … {end}, found none; add one")
    return head + start, end + tail


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
