"""Times of whole paintings and of their stages."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from gsgan.bench.speed_painter import Painter
from gsgan.model.avatar import unwatched
from gsgan.scene import Frame
from gsgan.utils.timing import timed, wait


@dataclass(frozen=True)
class Spread:
    """Median and the two deciles around it, milliseconds."""

    median: float
    p10: float
    p90: float

    @classmethod
    def of(cls, samples: Sequence[float]) -> Spread:
        """Of at least one sample; between samples linearly interpolated."""
        if len(samples) == 1:
            return cls(samples[0], samples[0], samples[0])
        deciles = statistics.quantiles(samples, n=10, method="inclusive")
        return cls(statistics.median(samples), deciles[0], deciles[8])


class StageClock:
    """What ``Avatar.stage`` becomes while stages are timed: waits for the device on both ends.

    Args:
        device: of the avatar.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.frame: dict[str, float] = {}  # milliseconds of each stage since the last reset

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        wait(self.device)
        start = time.perf_counter()
        yield
        wait(self.device)
        took = 1000 * (time.perf_counter() - start)
        self.frame[stage] = self.frame.get(stage, 0.0) + took


@dataclass(frozen=True)
class Times:
    """What was measured.

    Args:
        total: end to end, without waiting between stages.
        stages: each by itself, in the order of their first call.
        rest: of the frames timed by stage, what no stage took (copies, glue).
    """

    total: Spread
    stages: dict[str, Spread]
    rest: Spread


def measure(
    painter: Painter,
    frames: Sequence[Frame],
    *,
    count: int,
    warmup: int,
    tick: Callable[[], None] | None = None,
) -> Times:
    """Paints ``count`` frames end to end and as many by stage, in turn.

    Args:
        painter: paints.
        frames: gone through round and round.
        count: of frames timed each way.
        warmup: frames before the clock starts.
        tick: called after each frame.
    """
    device = frames[0].skeleton.device
    for i in range(warmup):
        painter(frames[i % len(frames)])
        if tick:
            tick()
    totals: list[float] = []
    rests: list[float] = []
    stages: dict[str, list[float]] = {}
    for i in range(count):
        frame = frames[i % len(frames)]
        totals.append(timed(lambda frame=frame: painter(frame), device))  # type: ignore[misc]
        whole, parts = _by_stage(painter, frame, device)
        rests.append(whole - sum(parts.values()))
        for name, took in parts.items():
            stages.setdefault(name, []).append(took)
        if tick:
            tick()
    return Times(
        Spread.of(totals), {name: Spread.of(s) for name, s in stages.items()}, Spread.of(rests)
    )


def _by_stage(
    painter: Painter, frame: Frame, device: torch.device
) -> tuple[float, dict[str, float]]:
    clock = StageClock(device)
    painter.avatar.stage = clock
    try:
        return timed(lambda: painter(frame), device), clock.frame
    finally:
        painter.avatar.stage = unwatched
