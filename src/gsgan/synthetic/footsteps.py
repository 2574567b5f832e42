"""Steps that follow the choreography: feet stand still, or swing to where they will be needed.

Convention: that of :mod:`gsgan.synthetic.controls`.
"""

import math

import numpy as np

from gsgan.synthetic.controls import STANCE, Array, Programme, controls_at, smoothstep

# seconds: from step to step of a foot, its two parts
PERIOD = 1.0
SWING = 0.42
STAND = 0.58
# metres and radians: a standing foot this near to its goal stays
SHORTEST = (0.03, 0.12)


class Footsteps:
    """The steps of both feet over the whole choreography: where they stand, and when they move.

    Feet take turns. At each turn, a foot steps to where it should be half-way through its next
    stand, unless it is there already.
    """

    def __init__(self, seed: int, programme: Programme) -> None:
        turns = np.arange(0, programme.duration, PERIOD)
        self.start: list[Array] = []  # per foot [K] seconds
        self.shift: list[Array] = []  # per foot [K, 3] x, y, heading
        self.height: list[Array] = []  # per foot [K] metres, 0 for no step
        for foot in range(2):
            start = turns + foot * PERIOD / 2
            goals, march = _standing(start + SWING + STAND / 2, seed, foot, programme)
            place = np.array([(1 - 2 * foot) * STANCE, 0, 0])
            shift = []
            height = []
            for goal, least in zip(goals, march, strict=True):
                move = goal - place
                far = np.linalg.norm(move[:2])
                steps = least > 0.03 or far > SHORTEST[0] or abs(move[2]) > SHORTEST[1]
                shift.append(move * steps)
                height.append(max(least, 0.03 + 0.15 * far) * steps)
                place = place + shift[-1]
            self.start.append(start)
            self.shift.append(np.array(shift))
            self.height.append(np.array(height))

    def at(self, times: Array, foot: int) -> tuple[Array, Array, Array, Array]:
        """Where a foot is at times ``[F]``: place ``[F, 3]``, and ``[F]`` height, pitch and load.

        The place is x, y, heading; pitch is in radians, positive lifts the heel; load is 1 while
        the foot swings and the other one carries the body.
        """
        t = times[:, None] - self.start[foot]
        stride = np.linalg.norm(self.shift[foot][:, :2], axis=1)
        place = (
            np.array([(1 - 2 * foot) * STANCE, 0, 0])
            + smoothstep(t / SWING) @ self.shift[foot]
        )
        height = _bump(t / SWING) @ self.height[foot]
        pitch = _bump((t + 0.12) / 0.45) @ np.minimum(1.6 * stride, 0.45)
        load = _bump((t + 0.15) / (SWING + 0.3)) @ (self.height[foot] > 0)
        return place, height, pitch, load


def _bump(u: Array) -> Array:
    return np.sin(math.pi * u.clip(0, 1)) ** 2


def _standing(
    times: Array, seed: int, foot: int, programme: Programme
) -> tuple[Array, Array]:
    """Where a foot should stand ``[F, 3]`` (x, y, heading), and the march's height ``[F]``."""
    times = times.clip(max=programme.duration - 1e-6)
    c = controls_at(times, seed, programme)
    sign = 1 - 2 * foot
    heading = c.path[:, 2]
    x = sign * (STANCE + c.foot[:, foot, 0])
    y = c.foot[:, foot, 1]
    cosine = np.cos(heading)
    sine = np.sin(heading)
    turned = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)
    return np.column_stack([c.path[:, :2] + turned, heading]), c.march
