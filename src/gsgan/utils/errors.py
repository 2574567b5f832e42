"""Errors that are shown to the user as one sentence, without a traceback."""

from collections.abc import Iterator
from contextlib import contextmanager


class GsganError(Exception):
    """An error that the user can fix: the message names what, where and what to do."""


class DataError(GsganError):
    """A file or folder is missing, damaged or has unexpected content."""


class ConfigError(GsganError):
    """A config value is unknown or contradicts another."""


@contextmanager
def explain(cause: str | None) -> Iterator[None]:
    """Errors of data inside begin with their cause, if it is known."""
    try:
        yield
    except DataError as error:
        if cause is None:
            raise
        raise DataError(f"{cause}; {error}") from None
