"""Appearance of the synthetic person: colours and patterns drawn from a seed.

Convention: colours are sRGB in [0, 1]; albedo is a function of the rest-pose position in metres, so
it has no seams and no resolution.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Colour = tuple[float, float, float]

SKINS: tuple[Colour, ...] = (
    (0.93, 0.74, 0.62),
    (0.86, 0.65, 0.50),
    (0.73, 0.51, 0.36),
    (0.60, 0.41, 0.29),
    (0.47, 0.32, 0.23),
)
HAIRS: tuple[Colour, ...] = (
    (0.12, 0.09, 0.08),
    (0.30, 0.19, 0.12),
    (0.55, 0.36, 0.18),
    (0.80, 0.66, 0.40),
    (0.48, 0.20, 0.11),
)
EYES: tuple[Colour, ...] = ((0.25, 0.45, 0.65), (0.35, 0.24, 0.14), (0.30, 0.48, 0.30))
SHIRT_PATTERNS = ("stripes", "checks", "chevrons")
TROUSER_PATTERNS = ("denim", "tartan")
BADGES = ("star", "ring", "bolt")
STREAM = 54  # chosen for the look of identity 0, the default person


@dataclass(frozen=True)
class Identity:
    """Colours and patterns of one person."""

    skin: Colour
    hair: Colour
    eye: Colour
    shirt: tuple[Colour, Colour, Colour]  # main, second, badge
    shirt_pattern: str
    shirt_period: float  # metres
    badge: str  # on the chest
    trousers: tuple[Colour, Colour]  # main, lines
    trouser_pattern: str
    shoe: tuple[Colour, Colour, Colour]  # upper, sole, laces


def make_identity(seed: int) -> Identity:
    """The identity of a seed; every non-negative integer gives a different one."""
    rng = np.random.default_rng([STREAM, seed])
    tone = int(rng.integers(len(SKINS)))
    hair = HAIRS[int(rng.integers(len(HAIRS)))] if tone < 3 else HAIRS[int(rng.integers(2))]
    hue = float(rng.random())
    shirt = (_hsv(hue, 0.85, 0.75), _hsv(hue + 0.08, 0.08, 0.96), _hsv(hue + 0.5, 0.9, 0.95))
    legs = float(rng.uniform(0.52, 0.68))
    shoe = float(rng.random())
    return Identity(
        skin=SKINS[tone],
        hair=hair,
        eye=EYES[int(rng.integers(len(EYES)))],
        shirt=shirt,
        shirt_pattern=SHIRT_PATTERNS[int(rng.integers(len(SHIRT_PATTERNS)))],
        shirt_period=float(rng.uniform(0.07, 0.10)),
        badge=BADGES[int(rng.integers(len(BADGES)))],
        trousers=(_hsv(legs, 0.55, 0.42), _hsv(legs, 0.25, 0.72)),
        trouser_pattern=TROUSER_PATTERNS[int(rng.integers(len(TROUSER_PATTERNS)))],
        shoe=(_hsv(shoe, 0.8, 0.7), (0.95, 0.95, 0.93), _hsv(shoe + 0.4, 0.2, 0.95)),
    )


def _hsv(hue: float, saturation: float, value: float) -> Colour:
    return colorsys.hsv_to_rgb(hue % 1.0, saturation, value)


class Marks:
    """Anchor points of the patterns from rest landmarks ``[33, 3]``, metres; left, then right."""

    def __init__(self, p: Array) -> None:
        self.eyes, self.mouth = p[[2, 5]], p[[9, 10]]
        self.shoulders, self.elbows, self.wrists = p[[11, 12]], p[[13, 14]], p[[15, 16]]
        self.hips = p[[23, 24]]
        self.chest = 0.74 * self.shoulders.mean(axis=0) + 0.26 * self.hips.mean(axis=0)


def albedo(identity: Identity, marks: Marks, points: Array, surface: Ints) -> Array:
    """sRGB albedo ``[N, 3]`` of rest-pose points ``[N, 3]`` on surfaces ``[N]``.

    Surfaces are numbered skin, hair, eye, shirt, trousers, shoe, as in the free body's asset.
    """
    out = np.zeros((len(points), 3))
    for number, paint in enumerate((_skin, _hair, _eye, _shirt, _trousers, _shoe)):
        here = surface == number
        out[here] = paint(identity, marks, points[here])
    return out


def _mix(base: Array, colour: Colour | Array, share: Array) -> Array:
    return base + share[:, None] * (np.asarray(colour) - base)


def _flat(colour: Colour, n: int) -> Array:
    return np.tile(np.asarray(colour, dtype=np.float64), (n, 1))


def _band(x: Array, width: float = 0.5) -> Array:
    """1 on the first ``width`` of every unit, 0 on the rest."""
    return (np.mod(x, 1.0) < width).astype(np.float64)


def _along(p: Array, start: Array, end: Array) -> Array:
    bone = end - start
    return (p - start) @ bone / (bone @ bone)


def _skin(who: Identity, marks: Marks, p: Array) -> Array:
    out = _flat(who.skin, len(p))
    front = p[:, 1] < marks.eyes[:, 1].mean() + 0.035
    eye_z, eye_x = marks.eyes[:, 2].mean(), marks.eyes[0, 0]
    across = (np.abs(p[:, 0]) - eye_x) / 0.023
    brow_z = eye_z + 0.024 - 0.006 * across**2
    brow = front & (np.abs(across) < 1) & (np.abs(p[:, 2] - brow_z) < 0.0045)
    out = _mix(out, tuple(0.7 * np.asarray(who.hair)), 0.85 * brow)
    mouth = marks.mouth.mean(axis=0)
    lips = ((p[:, 0] - mouth[0]) / 0.027) ** 2 + ((p[:, 2] - mouth[2]) / 0.011) ** 2
    red = np.asarray(who.skin) * np.array([0.92, 0.62, 0.62])
    out = _mix(out, red, 0.9 * (front & (lips < 1)))
    # a watch on the left, a bracelet on the right: bare arms would have no features
    for i, (colour, low, high) in enumerate(
        (((0.08, 0.08, 0.10), 0.84, 0.93), (who.shirt[2], 0.89, 0.93))
    ):
        side = p[:, 0] > 0 if i == 0 else p[:, 0] < 0
        at = _along(p, marks.elbows[i], marks.wrists[i])
        far = np.abs(p[:, 0]) > 0.5 * abs(marks.elbows[i, 0])
        near = (at > low) & (at < high) & side & far & (p[:, 2] < marks.shoulders[0, 2] - 0.1)
        near &= p[:, 2] > 0.9 * marks.hips[0, 2]
        out = _mix(out, colour, near.astype(np.float64))
    return out


def _hair(who: Identity, marks: Marks, p: Array) -> Array:
    centre = marks.eyes.mean(axis=0) + np.array([0.0, 0.09, 0.03])
    q = p - centre
    strands = np.sin(70 * np.arctan2(q[:, 0], q[:, 2] + 0.05) + 25 * q[:, 1])
    tone = 1.0 + 0.30 * strands
    return np.clip(_flat(who.hair, len(p)) * tone[:, None], 0, 1)


def _eye(who: Identity, marks: Marks, p: Array) -> Array:
    centre = np.where(p[:, :1] > 0, marks.eyes[0], marks.eyes[1])
    off = np.linalg.norm((p - centre)[:, [0, 2]], axis=1)
    out = _flat((0.93, 0.93, 0.92), len(p))
    out = _mix(out, who.eye, (off < 0.0062).astype(np.float64))
    return _mix(out, (0.02, 0.02, 0.02), (off < 0.0028).astype(np.float64))


def _shirt(who: Identity, marks: Marks, p: Array) -> Array:
    out = _flat(who.shirt[0], len(p))
    side = np.where(p[:, 0] > 0, 0, 1)
    on_arm = np.abs(p[:, 0]) > np.abs(marks.shoulders[0, 0]) + 0.01
    on_arm &= p[:, 2] > marks.elbows[0, 2] - 0.1  # the hem may be as wide as the shoulders
    span = np.linalg.norm(marks.elbows[0] - marks.shoulders[0])
    at = np.where(
        side == 0,
        _along(p, marks.shoulders[0], marks.elbows[0]),
        _along(p, marks.shoulders[1], marks.elbows[1]),
    )
    down = np.where(on_arm, at * span, marks.shoulders[0, 2] - p[:, 2]) / who.shirt_period
    across = p[:, 0] / who.shirt_period
    if who.shirt_pattern == "stripes":
        pattern = _band(down)
    elif who.shirt_pattern == "checks":
        pattern = 0.5 * _band(down) + 0.5 * _band(across)
    else:
        pattern = _band(down + np.abs(np.mod(across, 2.0) - 1.0))
    out = _mix(out, who.shirt[1], 0.9 * pattern)
    cuff = on_arm & (at > 0.73)
    out = _mix(out, who.shirt[2], cuff.astype(np.float64))
    knit = 0.94 + 0.06 * np.sin(2 * np.pi * p[:, 2] / 0.008)
    return _badge(who, marks, p, out * knit[:, None])


def _badge(who: Identity, marks: Marks, p: Array, out: Array) -> Array:
    """Adds a disc with a sign on the chest, and a bar with two dots on the back."""
    x, z = p[:, 0] - marks.chest[0], p[:, 2] - marks.chest[2]
    front = p[:, 1] < marks.chest[1] - 0.02
    r = np.hypot(x, z)
    disc, edge = front & (r < 0.085), front & (r < 0.085) & (r > 0.073)
    out = _mix(out, (0.97, 0.97, 0.95), disc.astype(np.float64))
    angle = np.arctan2(x, z)
    if who.badge == "star":
        sector = np.abs(np.mod(angle * 5 / (2 * np.pi) + 0.5, 1.0) - 0.5) * 2
        sign = r < 0.066 - 0.042 * sector
    elif who.badge == "ring":
        sign = (r < 0.055) & (r > 0.030) & ~((np.abs(z) < 0.012) & (x > 0))
    else:
        sign = (np.abs(x + 0.6 * z - 0.02 * np.sign(z)) < 0.018) & (np.abs(z) < 0.06)
    out = _mix(out, who.shirt[2], (disc & sign).astype(np.float64))
    out = _mix(out, (0.10, 0.10, 0.14), edge.astype(np.float64))
    back = p[:, 1] > marks.chest[1] + 0.02
    bar = back & (np.abs(z - 0.03) < 0.022) & (np.abs(x) < 0.11)
    dots = back & (np.hypot(np.abs(x) - 0.05, z + 0.055) < 0.030)
    return _mix(out, who.shirt[2], (bar | dots).astype(np.float64))


def _trousers(who: Identity, marks: Marks, p: Array) -> Array:
    out = _flat(who.trousers[0], len(p))
    if who.trouser_pattern == "denim":
        twill = _band((p[:, 0] + p[:, 2] + p[:, 1]) / 0.006, 0.4)
        worn = np.exp(-(((np.abs(p[:, 0]) - 0.12) / 0.04) ** 2)) * (p[:, 1] < 0)
        out = _mix(out, who.trousers[1], 0.35 * twill + 0.25 * worn)
    else:
        lines = np.maximum(_band(p[:, 2] / 0.075, 0.28), _band(p[:, 0] / 0.075, 0.28))
        thin = np.maximum(_band(p[:, 2] / 0.075 + 0.4, 0.1), _band(p[:, 0] / 0.075 + 0.4, 0.1))
        out = _mix(_mix(out, who.trousers[1], 0.7 * lines), (0.9, 0.75, 0.3), 0.7 * thin)
    outer = np.abs(p[:, 0]) - np.abs(marks.hips[0, 0])
    piping = (outer > 0.03) & (np.abs(p[:, 1] - marks.hips[0, 1] - 0.01) < 0.014)
    return _mix(out, (0.93, 0.90, 0.85), 0.9 * piping)


def _shoe(who: Identity, marks: Marks, p: Array) -> Array:
    out = _flat(who.shoe[0], len(p))
    laces = (p[:, 1] < -0.05) & (p[:, 1] > -0.14) & (p[:, 2] > 0.045)
    out = _mix(out, who.shoe[2], laces * _band(p[:, 1] / 0.022))
    return _mix(out, who.shoe[1], (p[:, 2] < 0.022).astype(np.float64))
