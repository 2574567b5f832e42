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
    expected = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
    if name not in arrays:
        raise DataError(
            f"{path} has no array '{name}'; expected one of shape {expected}"
        )
    array = arrays[name]
    if array.ndim != len(shape) or any(
        due is not None and due != found
        for due, found in zip(shape, array.shape, strict=True)
    ):
        raise DataError(
            f"{path}: '{name}' must have shape {expected}, found {array.shape}"
        )
    if array.dtype.kind not in "iuf":
        raise DataError(f"{path}: '{name}' must hold numbers, found {array.dtype}")
    return array


def as_floats(raw: Any) -> Float:
    """A float64 copy of lists or arrays; empty when they are ragged or hold no numbers."""
    try:
        return np.array(raw, np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)


def nanmedian(values: Float, axis: int = 0) -> Float:
    """The median along an axis, NaN where nothing is known, without numpy's warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmedian(values, axis=axis))


def evenly_spaced(count: int, most: int, *, ends: bool = False) -> list[int]:
    """At most ``most`` of ``count`` positions, rising: the middles of equal parts, or with ``ends``
    from the first to the last."""
    if ends:
        return sorted({round(x) for x in np.linspace(0, count - 1, min(count, most))})
    most = min(most, count)
    return [(2 * i + 1) * count // (2 * most) for i in range(most)]
