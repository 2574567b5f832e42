"""Peak memory of an action, measured in this process."""

from __future__ import annotations

import contextlib
import ctypes
import gc
from collections.abc import Callable

import torch

from gsgan.splat import buffers


def peak_memory(action: Callable[[], object], device: torch.device) -> float | None:
    """Megabytes by which the peak of this process grows while ``action`` runs a second time.

    Convention: free memory is returned to the system first, and the system's record of the peak is
    reset (``VmHWM`` of Linux); on CUDA it is the allocator's peak. None where neither is known.
    """
    action()  # what is built once is built
    gc.collect()
    buffers.forget()
    _reset(device)
    before = _peak(device)
    action()
    after = _peak(device)
    return None if before is None or after is None else (after - before) / 1e6


def _peak(device: torch.device) -> float | None:
    """Bytes: the most that was held since the reset."""
    if device.type == "cuda":
        return float(torch.cuda.max_memory_allocated(device))
    with contextlib.suppress(OSError, StopIteration), open("/proc/self/status") as stream:
        line = next(line for line in stream if line.startswith("VmHWM:"))
        return 1024.0 * int(line.split()[1])
    return None


def _reset(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return
    with contextlib.suppress(OSError, AttributeError):  # glibc keeps what was freed for reuse
        ctypes.CDLL(None).malloc_trim(0)
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as stream:
        stream.write("5")
