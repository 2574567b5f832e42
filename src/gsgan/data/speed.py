"""How fast pictures come from disk."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gsgan.data.datamodule import GsganData
    from gsgan.scene import Frame


@dataclass(frozen=True)
class LoaderSpeed:
    """What was measured.

    Args:
        frames: delivered while the clock ran.
        seconds: that took.
        workers: loading processes; 0 loads in the measuring one.
        size: ``(H, W)`` of the pictures.
        first: seconds until the first batch, starting the processes included.
    """

    frames: int
    seconds: float
    workers: int
    size: tuple[int, int]
    first: float

    @property
    def rate(self) -> float:
        """Frames a second."""
        return self.frames / self.seconds

    @property
    def rate_per_worker(self) -> float:
        """Frames a second and process."""
        return self.rate / max(self.workers, 1)


def measure_loader(
    data: GsganData, workers: int, batches: int = 50, seconds: float = 20.0
) -> LoaderSpeed:
    """Training pictures a second as the loader delivers them, each decoded from its files.

    Convention: the picture cache is switched off and comes back empty; batches that the processes
    had ready when the clock started are not counted.

    Args:
        data: whose training loader; its batch size and picture size count.
        workers: loading processes.
        batches: to measure; fewer when time runs out.
        seconds: after which no further batch is waited for.

    Raises:
        ValueError: when ``batches`` or ``seconds`` is not above 0.
    """
    if batches < 1 or seconds <= 0:
        raise ValueError(
            f"measure_loader: batches and seconds must be above 0, got {batches}, {seconds}"
        )
    before = data.workers, data.steps_per_epoch
    cache = data.dataset("train").cache
    limit, cache.limit = cache.limit, 0
    cache.clear()
    warm = 1 + 2 * workers  # what prefetching has ready
    data.workers, data.steps_per_epoch = workers, warm + batches
    try:
        return _measure(iter(data.train_dataloader()), workers, warm, seconds)
    finally:
        (data.workers, data.steps_per_epoch), cache.limit = before, limit


def _measure(loader: Iterator[Frame], workers: int, warm: int, seconds: float) -> LoaderSpeed:
    asked = time.perf_counter()
    frame = next(loader)
    first = time.perf_counter() - asked
    for _ in range(warm - 1):
        next(loader)
    frames, start = 0, time.perf_counter()
    for frame in loader:
        frames += len(frame)
        if time.perf_counter() - start > seconds:
            break
    taken = time.perf_counter() - start
    return LoaderSpeed(frames, taken, workers, frame.camera.size, first)
