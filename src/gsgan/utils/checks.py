"""Checks of config values: each returns the value, or raises a `ConfigError` that names the key.

NaN fails every check of a number, since it compares as false.
"""

from collections.abc import Iterable
from typing import Any

from gsgan.utils.errors import ConfigError


def _require(holds: bool, name: str, expected: str, value: Any) -> None:
    if not holds:
        raise ConfigError(f"{name} must be {expected}, got {value!r}")


def is_number(value: Any) -> bool:
    """Whether a value is a number; true and false are not."""
    # For Python they are integers.
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def between(name: str, value: Any, least: float, most: float) -> Any:
    """A number from ``least`` to ``most``, both included."""
    good = is_number(value) and least <= value <= most
    _require(good, name, f"a number from {least} to {most}", value)
    return value


def at_least(name: str, value: Any, least: float) -> Any:
    """A number of at least ``least``."""
    good = is_number(value) and value >= least
    _require(good, name, f"a number of at least {least}", value)
    return value


def above(name: str, value: Any, bound: float = 0) -> Any:
    """A number above ``bound``."""
    _require(is_number(value) and value > bound, name, f"a number above {bound}", value)
    return value


def whole(name: str, value: Any, least: int) -> int:
    """A whole number of at least ``least``."""
    # True and False are integers of Python.
    good = isinstance(value, int) and not isinstance(value, bool) and value >= least
    _require(good, name, f"a whole number of at least {least}", value)
    return int(value)


def one_of(name: str, value: Any, choices: Iterable[Any]) -> Any:
    """One of the choices."""
    # Types are compared too: True equals 1, and is not meant by it.
    choices = tuple(choices)
    known = any(type(value) is type(choice) and value == choice for choice in choices)
    _require(known, name, f"one of {', '.join(map(str, choices))}", value)
    return value
