"""Text and JSON files; files are written completely or not at all, also by a run that is killed."""

import codecs
import contextlib
import io
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsgan.utils.errors import DataError

# Text in quotes, which stays, or what JSON does not have: comments, and a comma before a bracket.
JSON_TEXT = r'("(?:[^"\\]|\\.)*")'
JSON_COMMENT = re.compile(JSON_TEXT + r"|//[^\n]*|/\*.*?\*/", re.DOTALL)
JSON_OBJECT = re.compile(r"(\s|//[^\n]*|/\*.*?\*/)*\{", re.DOTALL)
JSON_LAST_COMMA = re.compile(JSON_TEXT + r"|,(?=\s*[}\]])", re.DOTALL)
# Numbers between blanks, with a point or with a comma.
POINT_NUMBER = re.compile(r"(?<!\S)[-+]?\d*\.\d")
COMMA_NUMBER = re.compile(r"(?<!\S)([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)(?!\S)")


def cache_root() -> Path:
    """The folder for files that gsgan can make again: GSGAN_CACHE, by default the user's cache."""
    if os.environ.get("GSGAN_CACHE"):
        return Path(os.environ["GSGAN_CACHE"]).expanduser()

    # The place that the XDG specification gives.
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "gsgan"


def read_text(path: Path, errors: str = "strict") -> str:
    """The text of a file: UTF-8 with or without a byte order mark, or UTF-16 with one.

    Args:
        path: the file.
        errors: what happens to bytes that are no text, as for `bytes.decode`.

    Raises:
        OSError: if the file cannot be read.
        UnicodeDecodeError: if it is no such text and ``errors`` is ``strict``.
    """
    # UTF-16 begins with a byte order mark; the one of UTF-8 is dropped.
    content = path.read_bytes()
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return content.decode("utf-16" if wide else "utf-8-sig", errors)


def with_decimal_points(text: str) -> str:
    """The text, with points in place of decimal commas if none of its numbers has a point."""
    if POINT_NUMBER.search(text):
        return text
    return COMMA_NUMBER.sub(r"\1.\2", text)


def write_atomically(path: Path, content: str | bytes) -> None:
    """Writes under a temporary name beside ``path``, then renames."""
    # The process's id keeps processes apart that write the same file.
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    data = content.encode() if isinstance(content, str) else content

    # The content is on the disk before the file gets its name.
    try:
        with temporary.open("wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        error.filename = error.filename or str(path)  # a full disk names none
        raise
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns an `OSError` (disk full, read-only, not allowed) into a `DataError` with ``path``."""
    try:
        yield
    except OSError as error:
        raise DataError(
            f"{path} cannot be written ({error.strerror or error})"
        ) from None


def write_npz(path: Path, **arrays: Any) -> None:
    """Writes an npz completely or not at all."""
    # Packed in memory first, since the file is written in one go.
    stream = io.BytesIO()
    np.savez_compressed(stream, **arrays)
    with writing(path):
        write_atomically(path, stream.getvalue())


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes a JSON file completely or not at all; NaN becomes null."""
    with writing(path):
        write_atomically(path, json.dumps(_plain(content), indent=1) + "\n")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    # JSON has no NaN and no infinity.
    return (
        None if isinstance(value, float) and not np.isfinite(value) else value
    )


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        DataError: when the file is missing, is not JSON, or is not an object.
    """
    content = read_json_value(path)
    if not isinstance(content, dict):
        raise DataError(
            f"{path} must hold a JSON object, found {type(content).__name__}"
        )
    return content


def read_json_value(path: Path) -> Any:
    """The content of a JSON file, of any type; errors as `read_json`.

    Comments, and commas after a last entry, which editors allow, are left out.
    """
    # Deep nesting is a RecursionError, other damage a ValueError. From bytes, json finds out
    # whether the text is UTF-8, UTF-16 or UTF-32.
    try:
        content = path.read_bytes()
        try:
            return json.loads(content)
        except ValueError:
            return json.loads(_without_comments(content))
    except OSError as error:
        raise unreadable(path, error) from None
    except (ValueError, RecursionError) as error:
        refuse_empty(path)
        reason = str(error)
        if reason.startswith("Extra data"):
            reason = f"several values follow each other, expected one list of them ({reason})"
        raise DataError(f"{path} is not valid JSON: {reason}") from None


def _without_comments(content: bytes) -> str:
    """JSON text without comments, and without commas after the last entry of a list or object."""
    # Line ends stay, so that an error has the line of the file.
    text = content.decode(json.detect_encoding(content))

    def blank(match: re.Match[str]) -> str:
        return match[1] or "\n" * match[0].count("\n")

    return JSON_LAST_COMMA.sub(blank, JSON_COMMENT.sub(blank, text))


def is_json_object(head: str) -> bool:
    """Whether the start of a file is that of a JSON object, perhaps below comments."""
    return JSON_OBJECT.match(head) is not None


def refuse_empty(path: Path) -> None:
    """Raises a DataError for a file of 0 bytes."""
    if path.is_file() and path.stat().st_size == 0:
        raise DataError(f"{path} is empty (0 bytes); copy or export it again")


def unreadable(path: Path, error: OSError) -> DataError:
    """The error for the user about a file that cannot be opened, with the reason."""
    if isinstance(error, FileNotFoundError):
        return DataError(
            f"{path} does not exist; docs/data.md lists the files of each format"
        )
    return DataError(f"{path} cannot be read: {error.strerror or error}")
