"""What a choreography controls, as smooth functions of time, and programmes of its passages.

Convention: metres of a person whose legs (hip to ankle) measure `LEG` and arms (shoulder to wrist)
`ARM`, Z up; the person faces -Y at the start and stands on z = 0. Passages describe where body,
wrists and feet go; feet follow in steps, planned ahead, and stand still between them. "Mirrored"
vectors have x pointing away from the middle of the body on both sides.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TAU = 2 * math.pi
# metres, to which all lengths here refer
LEG = 0.91
ARM = 0.56
WALK = "walk"  # the passage that moves the body along a path, a full turn round
STANCE = 0.1  # metres from the middle of the body to a standing foot


class Controls:
    """Targets of the body at F moments, standing with the arms down; pairs are left, right."""

    def __init__(self, frames: int) -> None:
        def still(*value: object) -> Array:
            return np.repeat(np.array(value, dtype=float)[None], frames, axis=0)

        # [F, 3] x, y of the body in the world and its heading, radians
        self.path = still(0, 0, 0)
        # [F, 3] body axes, metres from the standing position
        self.pelvis = still(0, 0, -0.004)
        self.lean = still(0, 0, 0)  # [F, 3] body axes, axis-angle of the pelvis
        self.spine = still(0, 0, 0)  # [F, 3] axis-angle, distributed over the spine
        self.head = still(0, 0, 0)  # [F, 3] axis-angle, distributed over neck and head
        # [F, 2, 3], mirrored, chest axes: metres from the shoulder; where the elbow points
        self.wrist = still(*[(0.12, -0.05, -0.52)] * 2)
        self.elbow = still(*[(0.35, 1.0, -0.2)] * 2)
        # [F, 2] forearm twist, radians from mid-way, positive: palm up
        self.palm = still(0, 0)
        self.flex = still(0, 0)  # [F, 2] wrist flexion towards the palm, radians
        # [F, 2, 5] finger flexion in [0, 1], thumb first
        self.curl = still(*[[0.25] * 5] * 2)
        # [F, 2, 5] added to the curl of fingers' first joints
        self.bend = still(*[[0] * 5] * 2)
        # [F, 2] radians between neighbouring fingers, added to rest's
        self.spread = still(0, 0)
        # [F, 2, 3] mirrored, chest axes: the middle finger's knuckle, metres from the middle of the
        # shoulders; where hand and palm face. NaN: wrist, palm and flex decide instead
        self.knuckle = still(*[[math.nan] * 3] * 2)
        self.pointing = still(*[(0, -1, 0)] * 2)
        self.facing = still(*[(-1, 0, 0)] * 2)
        # [F, 2, 2] mirrored, body axes, metres from standing
        self.foot = still(*[(0, 0)] * 2)
        # Limbs that leave steps and chest: their shares, in mirrored body axes on the floor. Feet:
        # x, y, turned out, height, pitch (positive lifts the heel), the toes' share of it
        # [F, 2] in [0, 1], of `step` and `grip`
        self.free = still(0, 0)
        self.hold = still(0, 0)
        self.step = still(*[(STANCE, 0, 0, 0, 0, 0)] * 2)  # [F, 2, 6]
        # [F, 2, 3] where the knee of a free leg points
        self.knee = still(*[(0.1, -1, 0)] * 2)
        # [F, 2, 3] wrist; its hand: pointing, facing
        self.grip = still(*[(0.3, -0.1, 0.9)] * 2)
        # [F] metres: least height of steps; 0: only where needed
        self.march = np.zeros(frames)
        self.swing = np.zeros(frames)  # [F] share of the arms' swing with the legs
        self.mouth = np.zeros(frames)  # [F] opening with vowels, in [0, 1]
        self.round = np.zeros(frames)  # [F] lips, in [0, 1]
        self.wide = np.zeros(frames)  # [F] lips, in [0, 1]
        self.smile = np.zeros(frames)  # [F] in [0, 1]
        self.brows = np.zeros(frames)  # [F] in [-1, 1], positive raises them


@dataclass(frozen=True)
class Style:
    """What the seed varies: amplitude, phase (radians) and leading hand (0 left, 1 right)."""

    amplitude: float
    phase: float
    lead: int


Passage = Callable[[Controls, Array, Style], None]


@dataclass(frozen=True)
class Programme:
    """Passages in their order; each starts and ends in the resting controls."""

    passages: tuple[tuple[str, Passage, float], ...]  # name, passage, seconds
    resting: Callable[[int], Controls] = Controls
    blend: float = 0.6  # seconds from rest into a passage, and back

    @property
    def ends(self) -> Array:
        """``[P]`` the end of each passage, seconds."""
        return np.cumsum([seconds for *_, seconds in self.passages])

    @property
    def duration(self) -> float:
        return float(self.ends[-1])

    def index_at(self, times: Array) -> NDArray[np.intp]:
        """``[F]`` the number of the passage at each time."""
        return np.searchsorted(self.ends, times, side="right").clip(
            max=len(self.passages) - 1
        )


def frame_times(frames: int, duration: float) -> Array:
    """``[F]`` seconds: even samples of a motion, in the middle of each step."""
    return (np.arange(frames) + 0.5) * duration / frames


def passages_at(times: Array, programme: Programme) -> tuple[str, ...]:
    """The passage at each of the times ``[F]``, seconds."""
    return tuple(programme.passages[i][0] for i in programme.index_at(times))


def controls_at(times: Array, seed: int, programme: Programme) -> Controls:
    """Targets at times ``[F]``, seconds: every passage starts and ends at rest."""
    index = programme.index_at(times)
    base = programme.resting(len(times))
    random = np.random.default_rng(seed)
    turns = np.zeros(len(times))
    for i, (passage_name, passage, seconds) in enumerate(programme.passages):
        draw = random.random(3)
        style = Style(0.85 + 0.3 * draw[0], TAU * draw[1], int(draw[2] < 0.5))
        here = np.flatnonzero(index == i)
        s = 1 - (programme.ends[i] - times[here]) / seconds
        moved = programme.resting(len(here))
        passage(moved, s, style)
        share = smoothstep(s * seconds / programme.blend)
        share = share * smoothstep((1 - s) * seconds / programme.blend)
        for name, rest in vars(base).items():
            # it starts and ends smoothly itself
            whole = passage_name == WALK and name == "path"
            w = np.ones(len(here)) if whole else share
            goal = getattr(moved, name)
            rest[here] += w.reshape(-1, *[1] * (goal.ndim - 1)) * (goal - rest[here])
        turns[index > i] += passage_name == WALK  # a full one
    base.path[:, 2] += TAU * turns
    return base


def smoothstep(x: Array) -> Array:
    """0 below 0, 1 above 1, a cubic between."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)
