"""Controls of a choreography as smooth functions of time, and programmes of its passages.

Lengths are metres of a person whose legs (hip to ankle) measure `LEG` and arms (shoulder to wrist)
`ARM`; Z is up; the person faces -Y at the start and stands on z = 0. Passages describe where body,
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
LEG = 0.91  # metres from hip to ankle
ARM = 0.56  # metres from shoulder to wrist
WALK = "walk"  # the passage that moves the body along a path, a full turn round
STANCE = 0.1  # metres from the middle of the body to a standing foot


class Controls:
    """Targets of the body at F moments, standing with the arms down; pairs are left, right."""

    def __init__(self, frames: int) -> None:
        def still(*value: object) -> Array:
            return np.repeat(np.array(value, dtype=float)[None], frames, axis=0)

        def both(*value: object) -> Array:
            return still(value, value)

        # [F, 3] x, y of the body in the world and its heading, radians
        self.path = still(0, 0, 0)
        # [F, 3] body axes, metres from the standing position
        self.pelvis = still(0, 0, -0.004)
        self.lean = still(0, 0, 0)  # [F, 3] body axes, axis-angle of the pelvis
        # [F, 3] axis-angle, distributed over the spine
        self.spine = still(0, 0, 0)
        # [F, 3] axis-angle, distributed over neck and head
        self.head = still(0, 0, 0)

        # [F, 2, 3] mirrored, chest axes: the wrist, metres from the shoulder
        self.wrist = both(0.12, -0.05, -0.52)
        # [F, 2, 3] mirrored, chest axes: direction in which the elbow points
        self.elbow = both(0.35, 1.0, -0.2)
        # [F, 2] forearm twist, radians from mid-way, positive: palm up
        self.palm = still(0, 0)
        # [F, 2] wrist flexion towards the palm, radians
        self.flex = still(0, 0)
        # [F, 2, 5] finger flexion in [0, 1], thumb first
        self.curl = both(0.25, 0.25, 0.25, 0.25, 0.25)
        # [F, 2, 5] added to the curl of the first joint of each finger
        self.bend = both(0, 0, 0, 0, 0)
        # [F, 2] radians between neighbouring fingers, added to the angle at rest
        self.spread = still(0, 0)

        # [F, 2, 3] mirrored, chest axes: the middle finger's knuckle, metres from the middle of the
        # shoulders. If it is NaN, wrist, palm and flex place the hand instead.
        self.knuckle = both(math.nan, math.nan, math.nan)
        # [F, 2, 3] mirrored, chest axes: directions of the hand and of its palm
        self.pointing = both(0, -1, 0)
        self.facing = both(-1, 0, 0)

        # [F, 2, 2] mirrored, body axes: the feet, metres from standing
        self.foot = both(0, 0)
        # [F, 2] in [0, 1]: shares of `step` and of `grip`, the targets of limbs that leave the
        # footsteps and the chest. These are in mirrored body axes on the floor.
        self.free = still(0, 0)
        self.hold = still(0, 0)
        # [F, 2, 6] a free foot: x, y, turned out, height, pitch (positive lifts the heel), and the
        # toes' share of the pitch
        self.step = both(STANCE, 0, 0, 0, 0, 0)
        # [F, 2, 3] direction in which the knee of a free leg points
        self.knee = both(0.1, -1, 0)
        # [F, 2, 3] the wrist of a free arm; its hand follows `pointing` and `facing`
        self.grip = both(0.3, -0.1, 0.9)

        # [F] minimum height of steps, metres; 0: only as high as needed
        self.march = np.zeros(frames)
        # [F] share of the arms' swing with the legs
        self.swing = np.zeros(frames)

        # [F] the face
        self.mouth = np.zeros(frames)  # opening with vowels, in [0, 1]
        self.round = np.zeros(frames)  # lips, in [0, 1]
        self.wide = np.zeros(frames)  # lips, in [0, 1]
        self.smile = np.zeros(frames)  # in [0, 1]
        self.brows = np.zeros(frames)  # in [-1, 1], positive raises them

    def set_face(self, **values: Array | float) -> None:
        """Sets mouth, round, wide, smile or brows: numbers, or arrays ``[F]``."""
        for name, value in values.items():
            getattr(self, name)[:] = value


def place(
    points: Array, x: Array | float, y: Array | float, z: Array | float
) -> None:
    """Sets points or directions ``[F, 3]`` from numbers, or arrays ``[F]``."""
    points[:, 0] = x
    points[:, 1] = y
    points[:, 2] = z


def rotate(
    part: Array,
    forwards: Array | float = 0.0,
    sideways: Array | float = 0.0,
    turn: Array | float = 0.0,
) -> None:
    """Adds to the axis-angles ``[F, 3]`` of pelvis, spine or head, radians."""
    part[:, 0] += forwards
    part[:, 1] += sideways
    part[:, 2] += turn


@dataclass(frozen=True)
class Style:
    """Style of a passage, which the seed varies: amplitude, phase and leading hand."""

    amplitude: float  # from 0.85 to 1.15
    phase: float  # radians
    lead: int  # 0 left, 1 right


Passage = Callable[[Controls, Array, Style], None]


@dataclass(frozen=True)
class Programme:
    """Passages in their order; each starts and ends in the resting controls."""

    passages: tuple[tuple[str, Passage, float], ...]  # name, passage, seconds
    resting: Callable[[int], Controls] = Controls  # for a number of frames
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
        index = np.searchsorted(self.ends, times, side="right")
        return index.clip(max=len(self.passages) - 1)


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
        # Every passage draws its style, whether or not a frame lies in it.
        draw = random.random(3)
        style = Style(
            amplitude=0.85 + 0.3 * draw[0],
            phase=TAU * draw[1],
            lead=int(draw[2] < 0.5),
        )

        # The targets of the frames in this passage.
        here = np.flatnonzero(index == i)
        s = 1 - (programme.ends[i] - times[here]) / seconds
        moved = programme.resting(len(here))
        passage(moved, s, style)

        # The targets fade in from rest and out to rest.
        share = smoothstep(s * seconds / programme.blend)
        share = share * smoothstep((1 - s) * seconds / programme.blend)
        for name, rest in vars(base).items():
            weight = share
            # The path of the walk starts and ends smoothly itself.
            if passage_name == WALK and name == "path":
                weight = np.ones(len(here))
            change = getattr(moved, name) - rest[here]
            rest[here] += weight.reshape(-1, *[1] * (change.ndim - 1)) * change

        # After the walk, the heading has made a full turn.
        turns[index > i] += passage_name == WALK

    base.path[:, 2] += TAU * turns
    return base


def smoothstep(x: Array) -> Array:
    """0 below 0, 1 above 1, a cubic between: 3 x² - 2 x³."""
    x = np.clip(x, 0, 1)
    return x * x * (3 - 2 * x)
