"""Arrays from files: present, of the expected shape, and numbers, or one clear sentence."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsgan.utils.errors import DataError

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]


def expect_array(
    arrays: dict[str, NDArray[Any]],
    name: str,
    shape: tuple[int | None, ...],
    path: Path,
) -> NDArray[Any]:
    """One numeric array of the given shape, None standing for any length.

    Raises:
        DataError: when it is missing, has another shape, or holds no numbers.
    """
    # The shape in words, for every message.
    lengths = ["any" if length is None else str(length) for length in shape]
    expected = f"({', '.join(lengths)})"
    if name not in arrays:
        raise DataError(
            f"{path} has no array '{name}'; expected one of shape {expected}"
        )

    # Lengths that are given must agree, and so must their number.
    array = arrays[name]
    agrees = array.ndim == len(shape)
    for due, size in zip(shape, array.shape, strict=False):
        if due not in (None, size):
            agrees = False
    if not agrees:
        raise DataError(
            f"{path}: '{name}' must have shape {expected}, found {array.shape}"
        )

    # Signed and unsigned integers, and floats.
    if array.dtype.kind not in "iuf":
        raise DataError(
            f"{path}: '{name}' must hold numbers, found {array.dtype}"
        )
    return array


def as_floats(raw: Any) -> Float:
    """A float64 copy of lists or arrays; empty when they are ragged or hold no numbers."""
    # Nested lists of unequal lengths are a ValueError, other objects a TypeError.
    try:
        return np.array(raw, np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)


def nanmedian(values: Float, axis: int = 0) -> Float:
    """The median along an axis, NaN where nothing is known, without numpy's warning."""
    # numpy warns about every slice that has no known value.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmedian(values, axis=axis))


def evenly_spaced(count: int, maximum: int, *, ends: bool = False) -> list[int]:
    """At most ``maximum`` of ``count`` positions, rising: the middles of equal parts, or with
    ``ends`` from the first to the last."""
    maximum = min(maximum, count)
    if ends:
        return np.linspace(0, count - 1, maximum).round().astype(int).tolist()

    # The middle of part i is at (i + 1/2) count / most, rounded down.
    return [(2 * i + 1) * count // (2 * maximum) for i in range(maximum)]
