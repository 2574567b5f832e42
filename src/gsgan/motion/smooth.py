"""Skeletons of a stream, smoothed from the past alone."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsgan.utils.checks import at_least, positive

Float = NDArray[np.float64]


class _Last(NamedTuple):
    """The joints before: when, as they came, smoothed, and their velocities."""

    seconds: float
    p: Float
    smooth: Float
    velocity: Float


@dataclass
class OneEuro:
    """A One Euro filter of joints: a low-pass whose cut-off rises with the joint's speed.

    A joint at rest loses most of its noise; a fast one has little delay, at most
    1 / (2π min_cutoff) seconds. A joint that was not known, or that jumped, starts anew.

    Args:
        min_cutoff: Hz, of a joint at rest.
        beta: Hz per metre per second, by which a joint's speed raises its cut-off.
        speed_cutoff: Hz, of the low-pass of velocities.
        max_speed: metres per second; a faster joint has jumped.
        max_pause: seconds; after a longer one all joints start anew.

    Raises:
        ConfigError: on a value that is out of range.

    Source: Casiez et al. 2012, 1€ Filter.
    """

    min_cutoff: float = 1.5
    beta: float = 6.0
    speed_cutoff: float = 1.0
    max_speed: float = 15.0
    max_pause: float = 0.25
    _last: _Last | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        positive("smooth.min_cutoff", self.min_cutoff)
        at_least("smooth.beta", self.beta, 0)
        positive("smooth.speed_cutoff", self.speed_cutoff)
        positive("smooth.max_speed", self.max_speed)
        positive("smooth.max_pause", self.max_pause)

    def __call__(self, p: Float, seconds: float) -> Float:
        """The joints ``[J, 3]`` smoothed; metres, NaN where a joint is not known.

        Args:
            p: as they came.
            seconds: when they came; later than those before.
        """
        last = self._last
        if last is None or seconds - last.seconds > self.max_pause:
            self._last = _Last(seconds, p, p, np.zeros_like(p))
            return p

        # A joint that was or is not known has no speed, and counts as anew too.
        elapsed = seconds - last.seconds
        velocity = (p - last.p) / elapsed
        anew = ~(_length(velocity) <= self.max_speed)

        # The smoothed velocity sets the cut-off of each joint.
        share = _share(self.speed_cutoff, elapsed)
        velocity = last.velocity + share * (velocity - last.velocity)
        velocity = np.where(anew, 0, velocity)
        cutoff = self.min_cutoff + self.beta * _length(velocity)

        # Each joint moves a share of the way to its new place.
        moved = last.smooth + _share(cutoff, elapsed) * (p - last.smooth)
        smooth = np.where(anew, p, moved)
        self._last = _Last(seconds, p, smooth, velocity)
        return smooth


def _length(vectors: Float) -> Float:
    """``[J, 1]`` lengths of vectors ``[J, 3]``."""
    return np.linalg.norm(vectors, axis=-1, keepdims=True)


def _share(cutoff: float | Float, elapsed: float) -> float | Float:
    """The share of the way that a low-pass of ``cutoff`` Hz goes in ``elapsed`` seconds."""
    return elapsed / (elapsed + 1 / (2 * math.pi * cutoff))
