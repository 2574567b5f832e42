"""Left and right told apart: detectors swap a person's sides, mostly when seen from behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsgan.prepare.rig import Bool, Float, Rig
from gsgan.prepare.triangulate import Triangulation, robust_cost
from gsgan.utils.errors import ConfigError

Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class FlipSearch:
    """How swapped sides are found.

    Args:
        enabled: False trusts the detector.
        gain: mean loss a detection (0.7 is an error of ``scale``) that swapping a
            camera's left and right must save before it is believed.
        iterations: of reweighting while searching; fewer than the final triangulation needs.

    Raises:
        ConfigError: when a value is out of its range.
    """

    enabled: bool = True
    gain: float = 0.15
    iterations: int = 3

    def __post_init__(self) -> None:
        if not (self.gain >= 0 and self.iterations > 0):
            raise ConfigError(
                "flips.gain must be at least 0 and flips.iterations above 0, got "
                f"{self.gain!r} and {self.iterations!r}"
            )


def find_flips(
    rig: Rig,
    uv: Float,
    weight: Float,
    groups: Sequence[Pairs],
    search: FlipSearch,
    triangulation: Triangulation,
) -> Bool:
    """``[C, F, G]`` which camera swapped which group of joints in which frame.

    Each frame's swaps are found by changing one camera at a time while the triangulated points fit
    better. That leaves open whether all or none of the cameras swapped: what moves least from frame
    to frame decides, and over the whole passage the side that most detections say.

    Args:
        rig: ``C`` cameras.
        uv: ``[C, F, J, 2]`` undistorted pixels.
        weight: ``[C, F, J]`` confidence.
        groups: ``G`` tuples of (left, right) joints that swap together.
        search: thresholds.
        triangulation: scale and limits.
    """
    quick = replace(triangulation, iterations=search.iterations)
    found = [_group_flips(rig, uv, weight, pairs, search, quick) for pairs in groups]
    return np.stack(found, axis=-1)


def apply_flips(values: Float, flips: Bool, groups: Sequence[Pairs]) -> Float:
    """Values ``[C, F, J, ...]`` with the swapped groups put right."""
    out = values.copy()
    for g, pairs in enumerate(groups):
        at = flips[..., g]
        left, right = (list(side) for side in zip(*pairs, strict=True))
        for a, b in ((left, right), (right, left)):
            out[:, :, a] = np.where(_like(at, values), values[:, :, b], values[:, :, a])
    return out


def _like(at: Bool, values: Float) -> Bool:
    return at.reshape(*at.shape, *[1] * (values.ndim - 2))


def _group_flips(
    rig: Rig, uv: Float, weight: Float, pairs: Pairs, search: FlipSearch, quick: Triangulation
) -> Bool:
    joints = [j for pair in pairs for j in pair]
    local = tuple((2 * i, 2 * i + 1) for i in range(len(pairs)))
    uv, weight = uv[:, :, joints], weight[:, :, joints]
    C, F = weight.shape[:2]
    flips = np.zeros((C, F), bool)
    price = search.gain * weight.sum(-1)  # [C, F]
    cost = _cost(rig, uv, weight, flips, local, quick)
    active = np.arange(F)
    for _ in range(C):
        trials = np.stack(
            [_toggled(rig, uv[:, active], weight[:, active], flips[:, active], c, local, quick)
             for c in range(C)]
        )  # fmt: skip
        saved = cost[active] - trials - price[:, active]
        best = saved.argmax(0)
        better = saved.max(0) > 0
        active, best = active[better], best[better]
        if not len(active):
            break
        flips[best, active] ^= True
        cost[active] = trials[best, better.nonzero()[0]]
    exchanged = _exchanged(rig, uv, weight, flips, local, quick)
    return flips ^ exchanged


def _toggled(
    rig: Rig, uv: Float, weight: Float, flips: Bool, camera: int, pairs: Pairs, quick: Triangulation
) -> Float:
    flips = flips.copy()
    flips[camera] ^= True
    return _cost(rig, uv, weight, flips, pairs, quick)


def _points(
    rig: Rig, uv: Float, weight: Float, flips: Bool, pairs: Pairs, quick: Triangulation
) -> tuple[Float, Float]:
    """``p [F, J, 3]`` and the cost ``[F]`` when these cameras are swapped."""
    C, F, J = weight.shape
    uv = apply_flips(uv, flips[..., None], [pairs]).reshape(C, F * J, 2)
    weight = apply_flips(weight, flips[..., None], [pairs]).reshape(C, F * J)
    weight = np.where(weight > quick.min_confidence, weight, 0.0)
    points = replace(quick, max_error=np.inf).points(rig, uv, weight)
    seen = np.isfinite(points.error)
    cost = robust_cost(points.error, np.where(seen, weight, 0.0), quick.scale)
    return points.p.reshape(F, J, 3), cost.reshape(F, J).sum(-1)


def _cost(
    rig: Rig, uv: Float, weight: Float, flips: Bool, pairs: Pairs, quick: Triangulation
) -> Float:
    return _points(rig, uv, weight, flips, pairs, quick)[1]


def _exchanged(
    rig: Rig, uv: Float, weight: Float, flips: Bool, pairs: Pairs, quick: Triangulation
) -> Bool:
    """``[F]`` where the whole group is on the wrong side, by its motion and the majority."""
    p, _ = _points(rig, uv, weight, flips, pairs, quick)
    state = np.zeros(len(p), bool)
    last, known = p[0], np.isfinite(p[0]).all(-1)
    swap = [j ^ 1 for j in range(p.shape[1])]  # pairs lie side by side
    for f in range(1, len(p)):
        now = np.isfinite(p[f]).all(-1)
        both = known & now & known[swap] & now[swap]
        straight = np.linalg.norm(p[f] - last, axis=-1)[both].sum()
        crossed = np.linalg.norm(p[f][swap] - last, axis=-1)[both].sum()
        state[f] = crossed < straight if both.any() else state[f - 1]
        settled = p[f][swap] if state[f] else p[f]
        seen = now[swap] if state[f] else now
        last, known = np.where(seen[:, None], settled, last), known | seen
    says = weight.sum(-1)
    against = (says * (flips ^ state)).sum()
    return state ^ True if against > says.sum() / 2 else state
