"""Pictures' memory, used again: fresh memory costs as much as drawing on it.

A picture of 32 channels and 512 x 512 pixels is 8192 pages, which the system maps and clears in
every call when they are new; clearing memory that is mapped already takes a fraction of that.
"""

from __future__ import annotations

import math
import weakref

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

CACHE_LINE = 64  # bytes: rows of tiles are whole ones
LARGE = 1 << 20  # bytes from which memory is kept
KEPT = 1 << 28  # bytes that are kept at most while nobody uses them

_free: list[NDArray[np.uint8]] = []


def zeros(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Zeros on the CPU, aligned to cache lines.

    Large ones may use the memory of earlier ones that nobody holds any more.

    Args:
        shape: of the tensor.
        dtype: float32 or float64.
    """
    size = math.prod(shape) * dtype.itemsize + CACHE_LINE
    kept = _take(size) if size >= LARGE else None
    # numpy's zeros: large ones are huge pages, which the system clears when they are touched.
    memory = np.zeros(size, np.uint8) if kept is None else kept
    view = memory[:]  # lives as long as the tensors that share it
    if size >= LARGE:
        weakref.finalize(view, _give_back, memory).atexit = False
    first = -memory.ctypes.data % CACHE_LINE
    tensor = torch.from_numpy(view)[first : first + size - CACHE_LINE].view(dtype).view(shape)
    return tensor if kept is None else tensor.zero_()


def _take(size: int) -> NDArray[np.uint8] | None:
    for i, memory in enumerate(_free):
        if memory.nbytes == size:
            return _free.pop(i)
    return None


def _give_back(memory: NDArray[np.uint8]) -> None:
    _free.append(memory)
    while sum(m.nbytes for m in _free) > KEPT:
        _free.pop(0)
