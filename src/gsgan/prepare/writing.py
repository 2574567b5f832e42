"""What is said when the disk does not take a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsgan.utils.errors import DataError


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns a failure of the disk (full, read-only, not allowed) into one sentence.

    Raises:
        DataError: naming ``path``.
    """
    try:
        yield
    except OSError as error:
        raise DataError(f"{path} cannot be written ({error.strerror or error})") from None
