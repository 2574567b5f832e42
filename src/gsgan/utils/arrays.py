"""Arrays out of files: present, of the expected shape, and numbers, or one clear sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from gsgan.utils.errors import DataError


def expect_array(
    arrays: dict[str, NDArray[Any]], name: str, shape: tuple[int | None, ...], path: Path
) -> NDArray[Any]:
    """One numeric array of the given shape, None standing for any length.

    Raises:
        DataError: when it is missing, has another shape, or holds no numbers.
    """
    wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
    if name not in arrays:
        raise DataError(f"{path} has no array '{name}'; expected one of shape {wanted}")
    array = arrays[name]
    if array.ndim != len(shape) or any(
        want is not None and want != have for want, have in zip(shape, array.shape, strict=True)
    ):
        raise DataError(f"{path}: '{name}' must have shape {wanted}, found {array.shape}")
    if array.dtype.kind not in "iuf":
        raise DataError(f"{path}: '{name}' must hold numbers, found {array.dtype}")
    return array
