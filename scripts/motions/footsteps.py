"""Steps that follow the choreography: feet stand still, or swing to where they will be needed.

Units and axes are those of :mod:`motions.controls`.
"""

import math
from typing import NamedTuple

import numpy as np
from motions.controls import (
    STANCE,
    Array,
    Programme,
    controls_at,
    smoothstep,
)

PERIOD = 1.0  # seconds from step to step of a foot
SWING = 0.42  # seconds of a step
STAND = 0.58  # seconds from a step to the next
# A standing foot that is this near to its goal stays.
MIN_STEP = 0.03  # metres
MIN_TURN = 0.12  # radians


class FootState(NamedTuple):
    """A foot at F moments."""

    place: Array  # [F, 3] x, y, heading
    height: Array  # [F] metres
    pitch: Array  # [F] radians, positive lifts the heel
    toes: Array  # [F] minimum share of the pitch that the toes take
    # [F] 1 while the foot swings and the other one carries the body
    load: Array


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
            goals, march = _standing(
                start + SWING + STAND / 2, seed, foot, programme
            )

            # The foot steps from place to place.
            place = _first_place(foot)
            shift = []
            height = []
            for goal, minimum in zip(goals, march, strict=True):
                move = goal - place
                distance = np.linalg.norm(move[:2])

                # A foot steps if its goal is far enough, or if the passage
                # marches.
                far = distance > MIN_STEP or abs(move[2]) > MIN_TURN
                steps = minimum > 0.03 or far
                shift.append(move * steps)
                height.append(max(minimum, 0.03 + 0.15 * distance) * steps)
                place = place + shift[-1]
            self.start.append(start)
            self.shift.append(np.array(shift))
            self.height.append(np.array(height))

    def at(self, times: Array, foot: int) -> FootState:
        """The state of a foot at times ``[F]``: the sum of its steps until then."""
        t = times[:, None] - self.start[foot]
        shift = self.shift[foot]
        height = self.height[foot]
        stride = np.linalg.norm(shift[:, :2], axis=1)
        return FootState(
            place=_first_place(foot) + smoothstep(t / SWING) @ shift,
            height=_bump(t / SWING) @ height,
            pitch=_bump((t + 0.12) / 0.45) @ np.minimum(1.6 * stride, 0.45),
            toes=np.zeros(len(times)),
            load=_bump((t + 0.15) / (SWING + 0.3)) @ (height > 0),
        )


def _first_place(foot: int) -> Array:
    """Where a foot stands before its first step: x, y, heading."""
    return np.array([(1 - 2 * foot) * STANCE, 0, 0])


def _bump(u: Array) -> Array:
    """0 until 0, 1 at 0.5, 0 from 1."""
    return np.sin(math.pi * u.clip(0, 1)) ** 2


def _standing(
    times: Array, seed: int, foot: int, programme: Programme
) -> tuple[Array, Array]:
    """Where a foot should stand ``[F, 3]`` (x, y, heading), and the march's height ``[F]``."""
    # After the end, the person stays.
    times = times.clip(max=programme.duration - 1e-6)
    c = controls_at(times, seed, programme)

    # The foot beside the body's path, turned by the heading.
    sign = 1 - 2 * foot
    heading = c.path[:, 2]
    x = sign * (STANCE + c.foot[:, foot, 0])
    y = c.foot[:, foot, 1]
    cosine = np.cos(heading)
    sine = np.sin(heading)
    across = cosine * x - sine * y
    along = sine * x + cosine * y
    place = [c.path[:, 0] + across, c.path[:, 1] + along, heading]
    return np.column_stack(place), c.march
