"""Swapped sides: detectors confuse left and right, mostly when a person is seen from behind."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsgan.prepare.rig import Bool, Float, Rig, known
from gsgan.prepare.triangulate import Triangulation, robust_cost
from gsgan.utils.errors import ConfigError

Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class FlipSearch:
    """How swapped sides are found, see conf/prepare.yaml.

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

    Per frame, one camera at a time is changed as long as the triangulated points fit better. That
    does not determine whether all cameras swapped or none; the smaller motion from frame to frame
    and, over the whole sequence, the majority of the detections do.

    Args:
        rig: ``C`` cameras.
        uv: ``[C, F, J, 2]`` undistorted pixels.
        weight: ``[C, F, J]`` confidence.
        groups: ``G`` tuples of (left, right) joints that swap together.
        search: thresholds.
        triangulation: scale and limits.
    """
    quick = replace(triangulation, iterations=search.iterations, max_error=np.inf)
    weight = np.where(weight > quick.min_confidence, weight, 0.0)
    found = [_group_flips(rig, uv, weight, pairs, search.gain, quick) for pairs in groups]
    return np.stack(found, axis=-1)


def apply_flips(values: Float, flips: Bool, groups: Sequence[Pairs]) -> Float:
    """Values ``[C, F, J, ...]`` with left and right exchanged where ``flips [C, F, G]``."""
    out = values.copy()
    for g, pairs in enumerate(groups):
        at = flips[..., g].reshape(*flips.shape[:2], *[1] * (values.ndim - 2))
        left, right = (list(side) for side in zip(*pairs, strict=True))
        for a, b in ((left, right), (right, left)):
            out[:, :, a] = np.where(at, values[:, :, b], values[:, :, a])
    return out


def _group_flips(
    rig: Rig, uv: Float, weight: Float, pairs: Pairs, gain: float, quick: Triangulation
) -> Bool:
    """``[C, F]`` for one group."""
    joints = [j for pair in pairs for j in pair]  # pairs are then adjacent: j and j ^ 1
    local = [tuple((2 * i, 2 * i + 1) for i in range(len(pairs)))]
    uv, weight = uv[:, :, joints], weight[:, :, joints]
    C, F, J = weight.shape
    everywhere = np.arange(F)

    def points(flips: Bool, frames: NDArray[np.int64]) -> tuple[Float, Float]:
        """``p [F, J, 3]`` and the cost ``[F]`` of some frames with these flips ``[C, F]``."""
        sided, trust = (apply_flips(v[:, frames], flips[..., None], local) for v in (uv, weight))
        trust = trust.reshape(C, -1)
        found = quick.points(rig, sided.reshape(C, -1, 2), trust)
        seen = np.where(np.isfinite(found.error), trust, 0.0)
        cost = robust_cost(found.error, seen, quick.scale)
        return found.p.reshape(-1, J, 3), cost.reshape(-1, J).sum(-1)

    flips, price = np.zeros((C, F), bool), gain * weight.sum(-1)
    cost, active = points(flips, everywhere)[1], everywhere
    for _ in range(C):
        toggles = np.eye(C, dtype=bool)[:, :, None]
        trials = np.stack([points(flips[:, active] ^ one, active)[1] for one in toggles])
        saved = cost[active] - trials - price[:, active]
        best, better = saved.argmax(0), saved.max(0) > 0
        active, best = active[better], best[better]
        if not len(active):
            break
        flips[best, active] ^= True
        cost[active] = trials[best, better.nonzero()[0]]
    flips = flips ^ _exchanged(points(flips, everywhere)[0])
    votes = weight.sum(-1)
    return ~flips if (votes * flips).sum() > votes.sum() / 2 else flips


def _exchanged(p: Float) -> Bool:
    """``[F]`` frames whose sides ``p [F, J, 3]`` are exchanged against the first frame's."""
    state = np.zeros(len(p), bool)
    last, before = p[0], known(p[0])
    swap = [j ^ 1 for j in range(p.shape[1])]
    for f in range(1, len(p)):
        now = known(p[f])
        both = before & now & before[swap] & now[swap]
        straight = np.linalg.norm(p[f] - last, axis=-1)[both].sum()
        crossed = np.linalg.norm(p[f][swap] - last, axis=-1)[both].sum()
        state[f] = crossed < straight if both.any() else state[f - 1]
        settled, seen = (p[f][swap], now[swap]) if state[f] else (p[f], now)
        last, before = np.where(seen[:, None], settled, last), before | seen
    return state
