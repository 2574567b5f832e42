"""Checks of config values: each returns the value, or raises a `ConfigError` that names the key.

NaN fails every check of a number, since it compares as false.
"""

from collections.abc import Iterable
from typing import Any

from gsgan.utils.errors import ConfigError

AUTO = "auto"  # the value of an option that the data decides


def _require(holds: bool, name: str, expected: str, value: Any) -> None:
    if not holds:
        raise ConfigError(f"{name} must be {expected}, got {value!r}")


def is_number(value: Any) -> bool:
    """Whether a value is a number; true and false are not."""
    # For Python they are integers.
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def between(name: str, value: Any, minimum: float, maximum: float) -> Any:
    """A number from ``minimum`` to ``maximum``, both included."""
    good = is_number(value) and minimum <= value <= maximum
    _require(good, name, f"a number from {minimum} to {maximum}", value)
    return value


def at_least(name: str, value: Any, minimum: float) -> Any:
    """A number of at least ``minimum``."""
    good = is_number(value) and value >= minimum
    _require(good, name, f"a number of at least {minimum}", value)
    return value


def positive(name: str, value: Any) -> Any:
    """A number above 0."""
    good = is_number(value) and value > 0
    _require(good, name, "a number above 0", value)
    return value


def integer(name: str, value: Any, minimum: int) -> int:
    """A whole number of at least ``minimum``."""
    # True and False are integers of Python.
    good = (
        isinstance(value, int)
        and not isinstance(value, bool)
        and value >= minimum
    )
    _require(good, name, f"a whole number of at least {minimum}", value)
    return int(value)


def one_of(name: str, value: Any, choices: Iterable[Any]) -> Any:
    """One of the choices."""
    # Types are compared too: True equals 1, and is not meant by it.
    choices = tuple(choices)
    is_choice = any(
        type(value) is type(choice) and value == choice for choice in choices
    )
    _require(is_choice, name, f"one of {', '.join(map(str, choices))}", value)
    return value
