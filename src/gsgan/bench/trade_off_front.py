"""Which points nothing beats: the Pareto front of quality against cost."""

from __future__ import annotations

from collections.abc import Sequence


def front(cost: Sequence[float], quality: Sequence[float]) -> list[int]:
    """Indices of the points that no other beats, from the cheapest up.

    Convention: lower cost and higher quality are better. A point is beaten when another is at least
    as good in both and better in one; of equal points all stay.

    Args:
        cost: of each point, finite.
        quality: of each point, finite.
    """
    if len(cost) != len(quality):
        raise ValueError(f"front: got {len(cost)} costs and {len(quality)} qualities")
    found: list[int] = []
    best, best_cost = float("-inf"), float("-inf")
    for i in sorted(range(len(cost)), key=lambda i: (cost[i], -quality[i])):
        if quality[i] > best or (quality[i] == best and cost[i] == best_cost):
            found.append(i)
            best, best_cost = quality[i], cost[i]
    return found


def steps(x: Sequence[float], y: Sequence[float]) -> tuple[list[float], list[float]]:
    """The corners of the front as a step line: what can be had for at most so much.

    Args:
        x, y: cost and quality of the front's points, from the cheapest up.
    """
    if not x:
        return [], []
    across, up = [x[0]], [y[0]]
    for i in range(1, len(x)):
        across += [x[i], x[i]]
        up += [y[i - 1], y[i]]
    return across, up
