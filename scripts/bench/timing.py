"""Fair timing: every variant in turn, several rounds, medians."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Hashable, Mapping
from typing import TypeVar

import torch

from gsgan.bench.speed import measure_ms

Key = TypeVar("Key", bound=Hashable)


def interleaved(
    actions: Mapping[Key, Callable[[], object]],
    repeats: int,
    *,
    patience: float = float("inf"),
    device: torch.device | None = None,
    tick: Callable[[], None] | None = None,
) -> dict[Key, list[float]]:
    """Times actions round robin, so that other load on the machine affects all of them alike.

    Times are milliseconds of wall clock, with the device synchronised. Each action is called once
    to warm up. If that took longer than ``patience``, it is called once more, and the shorter of
    the two calls is its only sample.

    Args:
        actions: what to call, by name.
        repeats: rounds, at least 1.
        patience: seconds.
        device: synchronised before and after each call.
        tick: called after each call.

    Returns:
        The samples of each action: ``repeats`` of them, or one.
    """
    if repeats < 1:
        raise ValueError(
            f"interleaved: repeats must be at least 1, got {repeats}"
        )
    samples: dict[Key, list[float]] = {}
    for name, action in actions.items():
        first = measure_ms(action, device)
        slow = first > 1000 * patience
        samples[name] = [min(first, measure_ms(action, device))] if slow else []
        if tick:
            tick()
    quick = [name for name in actions if not samples[name]]
    for _ in range(repeats):
        for name in quick:
            samples[name].append(measure_ms(actions[name], device))
            if tick:
                tick()
    return samples


def median(samples: list[float] | None) -> float | None:
    """The median, or None without samples."""
    return statistics.median(samples) if samples else None
