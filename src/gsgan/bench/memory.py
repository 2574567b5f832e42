"""Peak memory of one way to draw, measured in a process of its own.

How: the child draws a tiny scene to load the backend, makes the real one, gives free memory back,
resets the system's record of its peak (both where they can be), notes it, draws once forward and
backward, and reports by how much the peak has grown. The peak is Linux's ``VmHWM``; its
``ru_maxrss`` would begin with the parent's, which survives fork and exec. Elsewhere it is
``ru_maxrss``, on CUDA the allocator's peak.
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

from gsgan.bench.judge import leaves
from gsgan.bench.scene import human_cloud, ring_camera
from gsgan.splat import Accuracy, rasterise

_log = logging.getLogger(__name__)
MEGABYTE = 1e6
TINY = (64, 16)  # Gaussians and pixels of the scene that loads the backend


def peak_memory(
    n: int, channels: int, size: int, settings: Accuracy, backend: str, **options: Any
) -> float | None:
    """Megabytes that one forward and backward pass takes on top of the scene.

    Args:
        n: Gaussians.
        channels: of the features.
        size: pixels, width and height.
        settings: cut-offs.
        backend: of ``rasterise``.
        options: ``seed``, ``shape``, ``device`` and ``threads``.

    Returns:
        None where the process did not get through (its last words are logged) or the system does
        not tell.
    """
    job = {"n": n, "channels": channels, "size": size, "settings": asdict(settings)}
    text = json.dumps(job | {"backend": backend} | options)
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

    def draw(n: int, size: int) -> None:
        gaussians = human_cloud(n, job["channels"], job["seed"], shape=job["shape"]).to(device)
        inputs, camera = leaves(gaussians), ring_camera(size).to(device)
        reset_peak(device)
        before.append(peak(device))
        raster = rasterise(inputs, camera, settings=settings, backend=job["backend"])
        grads = [torch.ones_like(raster.features), torch.ones_like(raster.alpha)]
        torch.autograd.backward([raster.features, raster.alpha], grads)

    before: list[float | None] = []
    draw(*TINY)
    draw(job["n"], job["size"])
    start, end = before[-1], peak(device)
    return None if start is None or end is None else (end - start) / MEGABYTE


def peak(device: torch.device) -> float | None:
    """Bytes: the most this process has held, since the reset where there was one."""
    if device.type == "cuda":
        return float(torch.cuda.max_memory_allocated(device))
    with contextlib.suppress(OSError, StopIteration), open("/proc/self/status") as stream:
        line = next(line for line in stream if line.startswith("VmHWM:"))
        return 1024.0 * int(line.split()[1])
    try:
        import resource
    except ImportError:  # not a Unix
        return None
    unit = 1 if sys.platform == "darwin" else 1024
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit)


def reset_peak(device: torch.device) -> None:
    """Forgets the peak so far, where the system lets us: else a past one could hide ours."""
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
