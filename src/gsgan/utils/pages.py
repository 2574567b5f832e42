"""Markdown tables, and marked blocks of a page that a command fills."""

from collections.abc import Sequence
from pathlib import Path

from gsgan.utils.errors import ConfigError
from gsgan.utils.files import write_atomically


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table; bars within cells are escaped."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(_cell(c) for c in line) + " |" for line in lines)


def fill_block(page: Path, start: str, end: str, text: str, *, key: str) -> None:
    """Replaces the text between the marker ``start`` and the next ``end``.

    Args:
        page: a Markdown file.
        start, end: the markers, HTML comments.
        text: to write between them.
        key: the config key of the page, for the message.

    Raises:
        ConfigError: when the page is missing or has no such block.
    """
    head, tail = _around(page, start, end, key)
    write_atomically(page, f"{head}\n\n{text.strip()}\n\n{tail}")


def check_block(page: Path, start: str, end: str, *, key: str) -> None:
    """Checks that ``fill_block`` will find its block, before anything long begins.

    Raises:
        ConfigError: as ``fill_block`` does.
    """
    _around(page, start, end, key)


def _around(page: Path, start: str, end: str, key: str) -> tuple[str, str]:
    """A page up to the start of a block, and from its end."""
    try:
        text = page.read_text()
    except FileNotFoundError:
        raise ConfigError(
            f"{key}={page}: no such page; give a Markdown file or {key}=null"
        ) from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{key}={page} cannot be read as a page: {error}") from None
    head, found, rest = text.partition(start)
    _, closed, tail = rest.partition(end)
    if not found or not closed:
        raise ConfigError(f"{key}={page}: expected a block {start} … {end}, found none; add one")
    return head + start, end + tail


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
