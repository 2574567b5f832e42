"""Peak memory of rasterising, measured in a process of its own.

The child draws a tiny scene to load the backend, makes the real one, returns free memory to the
system, resets the system's record of its peak (both where they can be), draws once forward and
backward, and reports by how much the peak has grown. The peak is Linux's ``VmHWM`` (``ru_maxrss``
would begin with the parent's, which survives fork and exec); on CUDA it is the allocator's.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import logging
import subprocess
import sys
from dataclasses import asdict
from typing import Any

import torch

from gsgan.bench.compare import leaves
from gsgan.bench.scene import human_cloud, ring_camera
from gsgan.splat import Accuracy, rasterise

_log = logging.getLogger(__name__)
MEGABYTE = 1e6
TINY = (64, 16)  # Gaussians and pixels of the scene that loads the backend


def peak_memory(settings: Accuracy, backend: str, **scene: Any) -> float | None:
    """Megabytes that one forward and backward pass takes on top of the scene.

    Args:
        settings: cut-offs.
        backend: of ``rasterise``.
        scene: ``n``, ``channels``, ``size`` in pixels, ``seed``, ``device`` and ``threads``.

    Returns:
        None where the process fails (the reason is logged) or the system does not report a peak.
    """
    text = json.dumps({"settings": asdict(settings), "backend": backend, **scene})
    command = [sys.executable, "-m", "gsgan.bench.memory", text]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        why = (done.stderr.strip().splitlines() or [f"it ended with {done.returncode}"])[-1]
        _log.warning("No peak memory of %s, %s: %s", backend, settings.name, why)
        return None
    found: float | None = json.loads(done.stdout.splitlines()[-1])
    return found


def measure(job: dict[str, Any]) -> float | None:
    """What the child does."""
    torch.set_num_threads(job["threads"])
    device, settings = torch.device(job["device"]), Accuracy(**job["settings"])
    grown = None
    for n, size in (TINY, (job["n"], job["size"])):
        inputs = leaves(human_cloud(n, job["channels"], job["seed"]).to(device))
        camera = ring_camera(size).to(device)
        reset_peak(device)
        before = peak(device)
        raster = rasterise(inputs, camera, settings=settings, backend=job["backend"])
        grads = [torch.ones_like(raster.features), torch.ones_like(raster.alpha)]
        torch.autograd.backward([raster.features, raster.alpha], grads)
        grown = growth(before, peak(device))
    return grown


def growth(before: float | None, after: float | None) -> float | None:
    """Megabytes."""
    return None if before is None or after is None else (after - before) / MEGABYTE


def peak(device: torch.device) -> float | None:
    """Bytes: the most this process has held since the reset; None where that is not known."""
    if device.type == "cuda":
        return float(torch.cuda.max_memory_allocated(device))
    with contextlib.suppress(OSError, StopIteration), open("/proc/self/status") as stream:
        line = next(line for line in stream if line.startswith("VmHWM:"))
        return 1024.0 * int(line.split()[1])
    return None


def reset_peak(device: torch.device) -> None:
    """Forgets the peak so far, which could hide the next one."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):  # glibc keeps what was freed for reuse
        ctypes.CDLL(None).malloc_trim(0)
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as stream:
        stream.write("5")


if __name__ == "__main__":
    print(json.dumps(measure(json.loads(sys.argv[1]))))
