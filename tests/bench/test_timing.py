"""Interleaving, patience, medians."""

import sys

import pytest
from commands import ROOT

from gsgan.bench import speed

sys.path.append(str(ROOT / "scripts" / "bench"))
from timing import interleaved


class Clock:
    """A clock that only the actions move."""

    def __init__(self) -> None:
        self.now = 0.0
        self.calls: list[str] = []

    def action(self, name: str, *seconds: float):
        times = list(seconds)

        def run() -> None:
            self.calls.append(name)
            self.now += times.pop(0) if len(times) > 1 else times[0]

        return run


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(speed.time, "perf_counter", lambda: clock.now)
    return clock


def test_round_robin_after_one_warm_up_each(clock):
    actions = {"a": clock.action("a", 9.0, 1.0, 2.0), "b": clock.action("b", 3.0)}
    samples = interleaved(actions, 2)
    assert clock.calls == ["a", "b", "a", "b", "a", "b"]
    assert samples == {"a": [1000.0, 2000.0], "b": [3000.0, 3000.0]}


def test_what_takes_longer_than_the_patience_is_called_twice_and_the_shorter_counts(clock):
    actions = {"slow": clock.action("slow", 9.0), "fast": clock.action("fast", 1.0)}
    samples = interleaved(actions, 3, patience=5.0)
    assert samples == {"slow": [9000.0], "fast": [1000.0] * 3}
    assert clock.calls.count("slow") == 2
