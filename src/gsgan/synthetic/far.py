"""The far choreography: what the everyday one never shows, to drive avatars far from training.

Convention: that of :mod:`gsgan.synthetic.controls`. A passage is a list of key poses at shares of
its time, from rest to rest; a pair of values is that of the leading side, then of the other.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsgan.synthetic.controls import Array, Controls, Passage, Programme, Style, smoothstep

Key = dict[str, Any]  # by control
ARC = 0.08  # height of a free foot on its way, in shares of the way
ASIDE = np.array([0.85, -0.5, 0.1])  # the way of wrists round their shoulders
MIRROR = dict.fromkeys(("lean", "spine", "head"), (1, -1, -1)) | {"pelvis": (-1, 1, 1)}


def keyed(*keys: tuple[float, Key]) -> Passage:
    """A passage through key poses; controls that a key leaves out are at rest there."""
    times = np.array([0.0, *(time for time, _ in keys), 1.0])
    poses: list[Key] = [{}, *({"hold": float("grip" in pose)} | pose for _, pose in keys), {}]

    def passage(c: Controls, s: Array, style: Style) -> None:
        i = (np.searchsorted(times, s, side="right") - 1).clip(0, len(times) - 2)
        u = smoothstep((s - times[i]) / (times[i + 1] - times[i]))
        for name in sorted({name for pose in poses for name in pose}):
            rest = getattr(Controls(1), name)[0]
            values = np.stack([_value(pose.get(name, rest), rest) for pose in poses])
            if style.lead:
                pair = rest.ndim > 1 or name in ("hold", "palm", "flex")
                values = values[:, ::-1] if pair else values * MIRROR.get(name, 1)
            w = u.reshape(-1, *[1] * rest.ndim)
            way = values[i + 1] - values[i]
            getattr(c, name)[...] = values[i] + w * way
            if name == "step":
                c.free[...] = 1
                far = np.linalg.norm(way[..., :2], axis=-1)
                c.step[..., 3] += ARC * far * np.sin(np.pi * u[:, None])
            elif name == "wrist":  # past the shoulder sideways, the arm not folded
                length = np.linalg.norm(values, axis=-1, keepdims=True)
                length = length[i] + w * (length[i + 1] - length[i])
                lost = (length**2 - (c.wrist**2).sum(axis=-1, keepdims=True)).clip(0)
                c.wrist += np.sqrt(lost) * ASIDE

    return passage


def _value(value: Any, rest: Array) -> Array:
    """A control ``[...]`` of a key: of both sides, or the same for both."""
    return np.broadcast_to(np.array(value, dtype=float), rest.shape)


STAND, FLAT = (0.1, 0, 0, 0, 0, 0), {"facing": (0, 0, -1), "curl": 0.08}
GUARD: Key = {"wrist": (-0.04, -0.3, 0.02), "elbow": (0.6, 0.3, -1), "curl": 0.9}
KNEELING = (0.1, 0.74, 0, 0.01, 2.4, 1)  # a foot behind its knee, its back on the floor

CHAMBER = GUARD | {
    "step": ((0.1, -0.3, 0, 0.55, 0.4, 1), STAND),
    "knee": ((0.15, -1, 0.6), (0.1, -1, 0)),
    "lean": (-0.1, 0, 0),
}
KICK = GUARD | {
    "step": ((0.08, -0.72, 0, 1.25, -1.3, 1), STAND),
    "knee": ((0.1, -1, 0.6), (0.1, -1, 0)),
    "lean": (-0.35, 0, 0),
    "spine": (0.25, 0, 0),
    "wrist": ((0.2, -0.2, -0.3), (0.0, -0.35, 0.05)),
}
SIDE_KICK = GUARD | {
    "step": ((0.72, -0.1, 0.3, 0.85, -0.1, 1), STAND),
    "knee": ((0.5, -1, 0.5), (0.1, -1, 0)),
    "lean": (0, -0.45, 0),
    "spine": (0, 0.1, 0),
    "wrist": ((0.3, -0.1, -0.3), (-0.1, -0.3, 0.0)),
}
LUNGE: Key = {
    "step": ((0.1, -0.44, 0, 0, 0, 0), (0.1, 0.42, 0, 0.015, 0.95, 0)),
    "knee": ((0.1, -1, 0.2), (0.1, -1, -0.6)),
    "pelvis": (0, 0, -0.37),
}
UP: Key = {"wrist": (0.0, 0.0, 0.53), "elbow": (1, -0.2, 0), "curl": 0.05}
DEEP: Key = {
    "step": (0.2, 0, 0.5, 0, 0, 0),
    "knee": (0.7, -1, 0.2),
    "pelvis": (0, 0.2, -0.6),
    "lean": (0.6, 0, 0),
    "spine": (0.35, 0, 0),
    "head": (-0.6, 0, 0),
}
TOUCH = DEEP | FLAT | {"spine": (0.7, 0, 0), "grip": (0.06, -0.3, 0.1), "pointing": (0, -1, -0.6)}
KNEEL: Key = {"step": KNEELING, "knee": (0.05, -1, -0.6), "pelvis": (0, 0.05, -0.48)}
HALF = KNEEL | {
    "step": ((0.1, -0.42, 0, 0, 0, 0), KNEELING),
    "knee": ((0.1, -1, 0.5), (0.05, -1, -0.6)),
}
SIT: Key = FLAT | {
    "step": (0.1, -0.82, 0.15, 0.19, -1.25, 1),
    "knee": (0.1, -0.3, 1),
    "pelvis": (0, 0.05, -0.88),
    "lean": (-0.45, 0, 0),
    "grip": (0.28, 0.42, 0.05),
    "pointing": (0.6, 0.8, 0),
    "elbow": (0.5, 1, 0),
}
HUG: Key = {
    "step": (0.12, -0.45, 0, 0, 0, 0),
    "knee": (0.1, -0.3, 1),
    "pelvis": (0, 0.05, -0.88),
    "spine": (0.3, 0, 0),
    "head": (0.2, 0, 0),
    "grip": (0.04, -0.47, 0.33),
    "pointing": (-1, -0.2, -0.2),
    "facing": (0, 1, 0),
    "elbow": (1, 0.2, -0.4),
}
OPEN = HUG | {"hold": 0, "wrist": (0.36, -0.3, -0.1), "elbow": (1, 0.5, -0.5), "spine": (0, 0, 0)}
SIT_TWISTED = SIT | {
    "step": ((0.12, -0.45, 0, 0, 0, 0), (0.1, -0.82, 0.1, 0.19, -1.25, 1)),
    "lean": (-0.15, 0, 0),
    "spine": (0, 0.1, 0.7),
    "head": (0, 0, 0.5),
    "hold": (1, 0),
    "wrist": ((0.12, -0.05, -0.52), (0, -0.4, 0.05)),
}
CLIMB: Key = {
    "pelvis": (0, -0.02, 0.1),
    "lean": (0.1, 0, 0),
    "step": ((0.2, -0.2, 0.4, 0.52, 0.1, 0), (0.12, -0.15, 0.1, 0.07, 0.35, 0)),
    "knee": ((0.6, -1, 0.3), (0.2, -1, 0)),
    "grip": ((0.2, -0.3, 1.45), (0.15, -0.28, 2.06)),
    "pointing": (-0.2, -0.4, 1),
    "facing": (0, -1, -0.3),
    "curl": 0.6,
    "elbow": (1, 0.3, -0.6),
    "head": (-0.4, 0, 0),
}
HIGHER = CLIMB | {
    "pelvis": (0, -0.02, 0.28),
    "step": ((0.2, -0.2, 0.2, 0.48, 0.2, 0), (0.18, -0.2, 0.4, 0.66, 0.1, 0)),
    "knee": ((0.4, -1, 0.2), (0.6, -1, 0.3)),
    "grip": ((0.15, -0.28, 2.24), (0.2, -0.3, 1.66)),
}
BEHIND: Key = {"wrist": (-0.14, 0.24, -0.4), "elbow": (1, 0.6, 0), "spine": (-0.2, 0, 0)}
BACKWARDS: Key = {"wrist": (0.12, 0.38, -0.36), "elbow": (0.3, 0.2, 1), "lean": (0.3, 0, 0)}
NAPE: Key = {"wrist": (-0.06, 0.06, 0.26), "elbow": (1, -0.1, 0.2), "palm": 0.3, "curl": 0.3}
FOLD: Key = FLAT | {
    "pelvis": (0, 0.26, -0.02),
    "lean": (1.4, 0, 0),
    "spine": (0.9, 0, 0),
    "grip": (0.1, -0.2, 0.16),
    "pointing": (0, -0.3, -1),
    "facing": (-0.6, 1, 0),
}
ARCHED = UP | {"lean": (-0.2, 0, 0), "spine": (-0.55, 0, 0), "pelvis": (0, -0.1, -0.03)}
SIDE = {
    "spine": (0, -0.6, 0),
    "lean": (0, -0.1, 0),
    "wrist": ((0.15, -0.1, -0.45), (-0.1, 0.0, 0.5)),
    "elbow": ((0.35, 1, -0.2), (1, -0.2, 0.2)),
}
TURNED = {
    "spine": (0.15, 0, 1.1),
    "lean": (0.2, 0, 0.25),
    "head": (0, 0, 0.5),
    "wrist": ((0.5, -0.1, 0), (0.1, -0.5, 0.0)),
}
CRAWL: Key = FLAT | {
    "pelvis": (0, 0.02, -0.455),
    "lean": (1.45, 0, 0),
    "head": (-0.7, 0, 0),
    "step": ((0.1, 0.66, 0, 0.015, 2.4, 1), (0.1, 0.9, 0, 0.015, 2.4, 1)),
    "knee": (0.05, -1, -0.8),
    "grip": ((0.2, -0.36, 0.05), (0.2, -0.58, 0.05)),
    "pointing": (0.1, -1, 0),
    "elbow": (0.6, 1, 0),
}
NEXT = CRAWL | {name: CRAWL[name][::-1] for name in ("step", "grip")}
PLANK = CRAWL | {
    "pelvis": (0, -0.1, -0.44),
    "lean": (1.27, 0, 0),
    "step": (0.1, 0.93, 0, 0.015, 0.9, 0),
    "knee": (0.05, -1, -0.3),
    "grip": (0.2, -0.62, 0.05),
}
FAR = Programme(
    (
        ("kick", keyed((0.3, CHAMBER), (0.5, KICK), (0.7, CHAMBER)), 3.0),
        ("side_kick", keyed((0.3, CHAMBER), (0.55, SIDE_KICK), (0.75, CHAMBER)), 3.0),
        ("lunge", keyed((0.3, LUNGE), (0.5, LUNGE | UP), (0.7, LUNGE | TURNED)), 4.0),
        ("deep_squat", keyed((0.3, DEEP | GUARD), (0.7, TOUCH)), 3.0),
        ("kneel", keyed((0.25, HALF), (0.5, KNEEL | UP), (0.75, HALF | TURNED)), 4.0),
        ("sit", keyed((0.2, SIT), (0.34, OPEN), (0.5, HUG), (0.64, OPEN), (0.8, SIT_TWISTED)), 6.0),
        ("climb", keyed((0.35, CLIMB), (0.65, HIGHER)), 3.5),
        ("arms_behind", keyed((0.2, NAPE), (0.4, BEHIND), (0.6, BACKWARDS), (0.8, UP)), 4.0),
        ("bend", keyed((0.22, FOLD), (0.5, ARCHED), (0.75, SIDE)), 4.0),
        ("twist", keyed((0.35, TURNED), (0.65, TURNED | LUNGE)), 3.0),
        ("crawl", keyed((0.25, CRAWL), (0.5, NEXT), (0.75, PLANK)), 4.5),
    )
)
