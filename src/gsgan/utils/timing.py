"""Fair timing: every variant in turn, several rounds, medians."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

import torch

Key = TypeVar("Key", bound=Hashable)


def interleaved(
    actions: Mapping[Key, Callable[[], object]],
    repeats: int,
    *,
    patience: float = float("inf"),
    device: torch.device | None = None,
    tick: Callable[[], None] | None = None,
) -> dict[Key, list[float]]:
    """Times actions round robin, so that a disturbance affects all alike.

    Convention: milliseconds of wall clock, with all work of the device finished. Each action
    is first called once to warm up; that call is not counted, except where it took longer than
    ``patience``: then it is called once more, and the shorter of the two is its only sample.

    Args:
        actions: what to call, by name.
        repeats: rounds, at least 1.
        patience: seconds.
        device: waits for it before and after each call.
        tick: called after each call.

    Returns:
        The samples of each action: ``repeats`` of them, or one.
    """
    if repeats < 1:
        raise ValueError(f"interleaved: repeats must be at least 1, got {repeats}")
    samples: dict[Key, list[float]] = {}
    for name, action in actions.items():
        first = timed(action, device)
        slow = first > 1000 * patience  # or a disturbance: call once more
        samples[name] = [min(first, timed(action, device))] if slow else []
        if tick:
            tick()
    quick = [name for name in actions if not samples[name]]
    for _ in range(repeats):
        for name in quick:
            samples[name].append(timed(actions[name], device))
            if tick:
                tick()
    return samples


def median(samples: list[float] | None) -> float | None:
    """The median, or None of nothing."""
    return statistics.median(samples) if samples else None


def timed(action: Callable[[], object], device: torch.device | None) -> float:
    """Milliseconds of one call, with all work of the device finished."""
    wait(device)
    start = time.perf_counter()
    result = action()
    wait(device)
    took = 1000 * (time.perf_counter() - start)
    del result  # freed outside the clock
    return took


def wait(device: torch.device | None) -> None:
    """Waits until the device has finished; returns at once on a CPU."""
    if device is not None and device.type == "cuda":
        torch.cuda.synchronize(device)
