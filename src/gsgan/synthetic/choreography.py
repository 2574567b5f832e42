"""The everyday choreography: passages from walking to a free style, and its held-out frames.

Convention: that of :mod:`gsgan.synthetic.controls`. Passages write into neutral controls, given
times in [0, 1] through the passage.
"""

import math
from collections.abc import Sequence

import numpy as np

from gsgan.synthetic.controls import (
    TAU,
    WALK,
    Array,
    Controls,
    Passage,
    Programme,
    Style,
    smoothstep,
)

COMBINATION = "squat_and_wave"


def walk(c: Controls, s: Array, style: Style) -> None:
    """Walking round an oval, and back to the start after a full turn to the left."""
    a = TAU * _ease(s)
    c.path[:, 0] = 0.2 * (1 - np.cos(a))
    c.path[:, 1] = -0.3 * np.sin(a)
    # heading along the oval, without jumps of a full turn
    cosine = np.cos(a)
    sine = np.sin(a)
    c.path[:, 2] = a - np.arctan2(0.1 * sine * cosine, 0.3 * cosine**2 + 0.2 * sine**2)
    c.swing[:] = style.amplitude
    c.head[:, 2] = 0.25 * np.sin(a)
    c.smile[:] = 0.3


def _ease(s: Array, share: float = 0.12) -> Array:
    """From 0 to 1 at constant speed, which starts and ends smoothly."""

    def begin(x: Array) -> Array:
        u = (x / share).clip(0, 1)
        return share * (u**3 - u**4 / 2) + (x - share).clip(0)

    return np.where(s < 0.5, begin(s), 1 - share - begin(1 - s)) / (1 - share)


def arm_swings(c: Controls, s: Array, style: Style) -> None:
    """Straight arms swung forwards, sideways and back, out of step."""
    for i, shift in enumerate((0.0, 0.35)):
        swing = 0.5 - 0.5 * np.cos(TAU * (s - 0.2 * shift))
        around = TAU * 1.5 * s + style.phase + shift * TAU
        angle = 1.55 * style.amplitude * swing
        out = 0.5 + 0.5 * np.sin(around)
        reach = 0.55
        c.wrist[:, i, 0] = 0.10 + reach * np.sin(angle) * out
        c.wrist[:, i, 1] = -0.04 - reach * np.sin(angle) * (1 - out)
        c.wrist[:, i, 2] = -reach * np.cos(angle)
    c.spine[:, 0] = -0.12 * np.sin(TAU * s)


def wave(c: Controls, s: Array, style: Style) -> None:
    """One hand waves beside the head, the other is on the hip."""
    _wave_arm(c, style.lead, TAU * 3 * s + style.phase, style.amplitude)
    other = 1 - style.lead
    c.wrist[:, other] = (0.13, -0.04, -0.36)
    c.elbow[:, other] = (1.0, 0.6, 0.0)
    c.curl[:, other] = 0.8
    c.head[:, 2] = (0.3 if style.lead == 0 else -0.3) * np.sin(math.pi * s)
    c.smile[:] = 1
    c.brows[:] = 0.6
    c.mouth[:] = 0.25 * _wander(s, 3, style.phase).clip(0)


def _wave_arm(c: Controls, side: int, phase: Array, amplitude: float) -> None:
    c.wrist[:, side, 0] = 0.24 + 0.12 * amplitude * np.sin(phase)
    c.wrist[:, side, 1] = -0.16
    c.wrist[:, side, 2] = 0.26
    c.elbow[:, side] = (1.0, 0.4, -0.9)
    c.palm[:, side] = -0.6
    c.curl[:, side] = 0.05


def squat(c: Controls, s: Array, style: Style) -> None:
    """Two squats, arms reaching forwards for balance."""
    depth = 0.5 - 0.5 * np.cos(TAU * 2 * s)
    _squat_legs(c, depth, style.amplitude)
    for i in range(2):
        c.wrist[:, i, 0] = 0.10 - 0.04 * depth
        c.wrist[:, i, 1] = -0.04 - 0.44 * depth
        c.wrist[:, i, 2] = -0.5 + 0.44 * depth


def _squat_legs(c: Controls, depth: Array, amplitude: float) -> None:
    c.pelvis[:, 2] += -0.36 * amplitude * depth
    c.pelvis[:, 1] += 0.16 * amplitude * depth
    c.lean[:, 0] += 0.45 * amplitude * depth
    c.spine[:, 0] += 0.15 * depth
    c.head[:, 0] += -0.35 * depth
    c.foot[:, :, 0] += 0.06


def overhead(c: Controls, s: Array, style: Style) -> None:
    """Both arms rise to above the head and circle there."""
    rise = np.sin(math.pi * s) ** 2
    for i, shift in enumerate((0.0, 1.3)):
        circle = TAU * 2 * s + style.phase + shift
        angle = rise * 2.75 * (0.92 + 0.08 * style.amplitude)
        c.wrist[:, i, 0] = 0.10 + 0.42 * np.sin(angle) + 0.05 * np.cos(circle) * rise
        c.wrist[:, i, 1] = -0.06 + 0.08 * np.sin(circle) * rise
        c.wrist[:, i, 2] = np.where(np.cos(angle) > 0, -0.48, -0.36) * np.cos(angle)
        c.elbow[:, i] = (1.0, 0.9, -0.1)
    c.curl[...] = (0.25 - 0.2 * rise)[:, None, None]
    c.head[:, 0] = -0.2 * rise
    c.mouth[:] = 0.5 * rise
    c.brows[:] = rise


def twist(c: Controls, s: Array, style: Style) -> None:
    """The trunk turns and leans from side to side, bent arms held out."""
    turn = np.sin(TAU * 1.5 * s + 0.3 * style.phase)
    c.spine[:, 2] = 0.75 * style.amplitude * turn
    c.spine[:, 1] = 0.35 * np.sin(TAU * s + style.phase)
    c.head[:, 2] = -0.4 * turn
    for i, sign in enumerate((1.0, -1.0)):
        c.wrist[:, i, 0] = 0.22 + 0.06 * sign * turn
        c.wrist[:, i, 1] = -0.30
        c.wrist[:, i, 2] = -0.12 + 0.10 * sign * turn
        c.elbow[:, i] = (1.0, 0.5, -0.5)
    c.curl[...] = 0.75
    c.brows[:] = -0.7


def reach(c: Controls, s: Array, style: Style) -> None:
    """One hand reaches high to its side, then low across the body; the gaze follows."""
    low = smoothstep((s - 0.35) / 0.3)
    high = 1 - low
    side = style.lead
    sign = 1.0 if side == 0 else -1.0
    c.wrist[:, side, 0] = 0.3 * high - 0.06 * low
    c.wrist[:, side, 1] = -0.2 * high - 0.42 * low
    c.wrist[:, side, 2] = 0.4 * high - 0.3 * low
    c.elbow[:, side] = (1.0, 0.5, -0.6)
    c.palm[:, side] = 0.5 * low - 0.5 * high
    c.curl[:, side] = (0.15 + 0.6 * np.exp(-(((s - 0.4) / 0.1) ** 2)))[:, None]
    c.spine[:, 0] = 0.45 * low - 0.1 * high
    c.spine[:, 1] = -0.2 * sign * high
    c.spine[:, 2] = -0.5 * sign * low + 0.25 * sign * high
    c.lean[:, 0] = 0.2 * low
    c.pelvis[:, 1:] += low[:, None] * (0.1, -0.1)
    c.head[:, 0] = 0.15 * low - 0.35 * high
    c.head[:, 2] = sign * (0.4 * high - 0.15 * low)
    c.mouth[:] = 0.15 * high


def signing(c: Controls, s: Array, style: Style) -> None:
    """Sign language in front of the chest, every finger with its own rhythm."""
    _sign_arms(c, s, style)
    c.head[:, 2] = 0.2 * np.sin(TAU * 1.5 * s)
    c.head[:, 0] = 0.12 * np.sin(TAU * 2.5 * s + 1)


def _sign_arms(c: Controls, s: Array, style: Style) -> None:
    for i, shift in enumerate((0.0, 2.1)):
        a = TAU * s + style.phase + shift
        c.wrist[:, i, 0] = 0.02 + 0.1 * np.sin(2 * a)
        c.wrist[:, i, 1] = -0.31 - 0.06 * style.amplitude * np.sin(3 * a + 1)
        c.wrist[:, i, 2] = -0.15 + 0.14 * style.amplitude * np.sin(3 * a)
        c.elbow[:, i] = (0.8, 0.3, -1.0)
        c.palm[:, i] = 0.1 + 0.7 * np.sin(2 * a + 0.5)
        c.flex[:, i] = 0.25 * np.sin(3 * a + 2)
        for finger in range(5):
            c.curl[:, i, finger] = 0.45 + 0.45 * np.sin(
                (2 + finger % 3) * a + 1.7 * finger
            )
    c.mouth[:] = 0.3 + 0.45 * _wander(s, 9, style.phase)
    c.smile[:] = 0.3 * _wander(s, 2, style.phase).clip(0)
    c.brows[:] = 0.9 * _wander(s, 3, style.phase + 1)


def squat_and_wave(c: Controls, s: Array, style: Style) -> None:
    """The held-out combination: a half squat while one hand waves and the other signs."""
    _sign_arms(c, s, style)
    _squat_legs(c, 0.65 * np.sin(math.pi * s) ** 2, style.amplitude)
    _wave_arm(c, style.lead, TAU * 2 * s + style.phase, style.amplitude)
    c.spine[:, 2] += 0.4 * np.sin(TAU * s)


def dance(c: Controls, s: Array, style: Style) -> None:
    """Steps from side to side with high knees, hips and arms in the same beat."""
    beat = TAU * 3 * s
    c.march[:] = 0.16 * style.amplitude
    c.path[:, 0] = 0.12 * np.sin(TAU * s)
    c.path[:, 2] = 0.4 * style.amplitude * np.sin(TAU * s)
    c.pelvis[:, 2] += -0.05 + 0.02 * np.cos(2 * beat)
    c.lean[:, 1] = 0.08 * np.sin(beat)
    c.spine[:, 1] = -0.2 * np.sin(beat)
    c.spine[:, 2] = 0.3 * np.sin(beat + 0.8)
    for i, sign in enumerate((1.0, -1.0)):
        c.wrist[:, i, 0] = 0.20 + 0.06 * sign * np.sin(beat)
        c.wrist[:, i, 1] = -0.26 - 0.08 * sign * np.sin(beat)
        c.wrist[:, i, 2] = -0.08 + 0.2 * np.sin(beat / 2 + sign + style.phase)
        c.elbow[:, i] = (1.0, 0.6, -0.5)
        c.palm[:, i] = 0.4 * np.sin(beat + sign)
    c.curl[...] = 0.5
    c.smile[:] = 0.9


def freestyle(c: Controls, s: Array, style: Style) -> None:
    """Arms, trunk, legs and heading move independently: poses that no other passage has.

    A model trained on the other passages alone is worst on poses between them.
    """
    for i, shift in enumerate((0.0, 2.6)):
        a = style.phase + shift
        # 0: down, half a turn: up
        rise = 1.25 + 1.1 * style.amplitude * _wander(s, 2.5, a)
        around = 0.75 + 0.7 * _wander(s, 3.2, a + 1)  # 0: in front, a quarter: sideways
        reach = 0.42 + 0.09 * _wander(s, 3.7, a + 2)
        c.wrist[:, i, 0] = 0.06 + reach * np.sin(rise) * np.sin(around)
        c.wrist[:, i, 1] = -0.04 - reach * np.sin(rise).clip(0.1) * np.cos(around)
        c.wrist[:, i, 2] = -reach * np.cos(rise)
        c.elbow[:, i] = (1.0, 0.6, -0.5)
        c.palm[:, i] = 0.6 * _wander(s, 2.8, a + 3)
        c.flex[:, i] = 0.25 * _wander(s, 3.5, a + 4)
        for finger in range(5):
            c.curl[:, i, finger] = 0.45 + 0.4 * _wander(s, 4, a + 5 + 0.9 * finger)
        c.foot[:, i, 0] = 0.04 + 0.04 * _wander(s, 1.9, a + 0.7)
        c.foot[:, i, 1] = 0.18 * _wander(s, 2.2, a + 2.2)
    _squat_legs(
        c, 0.6 * (0.5 + 0.5 * _wander(s, 2, style.phase + 6)) ** 2, style.amplitude
    )
    c.spine[:, 2] += 0.6 * _wander(s, 2.1, style.phase + 1.5)
    c.spine[:, 1] += 0.3 * _wander(s, 2.6, style.phase + 2.5)
    c.spine[:, 0] += 0.2 * _wander(s, 2.3, style.phase + 3.5)
    c.head[:, 2] += -0.3 * _wander(s, 2.9, style.phase + 4.5)
    c.head[:, 0] += 0.15 * _wander(s, 3.4, style.phase + 5.5)
    c.path[:, 2] = 0.9 * _wander(s, 1.4, style.phase + 0.5)
    c.mouth[:] = 0.5 * _wander(s, 6, style.phase + 7)
    c.smile[:] = 0.8 * _wander(s, 2, style.phase + 8)
    c.brows[:] = 0.9 * _wander(s, 3, style.phase + 9)


def _wander(s: Array, cycles: float, phase: float) -> Array:
    """Smooth, in [-1, 1], without period within a passage."""
    golden = (1 + math.sqrt(5)) / 2
    slow = TAU * cycles * s + phase
    fast = TAU * cycles * golden * s + 2.4 * phase + 1
    return 0.5 * (np.sin(slow) + np.sin(fast))


PASSAGES: tuple[tuple[str, Passage, float], ...] = (
    (WALK, walk, 5.5),
    ("arm_swings", arm_swings, 2.0),
    ("wave", wave, 2.5),
    ("squat", squat, 2.5),
    ("overhead", overhead, 2.5),
    ("twist", twist, 2.5),
    ("reach", reach, 2.5),
    ("signing", signing, 4.0),
    (COMBINATION, squat_and_wave, 3.0),
    ("dance", dance, 3.0),
    ("freestyle", freestyle, 5.0),
)
EVERYDAY = Programme(PASSAGES)


def held_out(names: Sequence[str], test_frames: int, block: int = 3) -> list[int]:
    """The held-out frames: the combination passage first, then blocks inside the others.

    Blocks lie in the middle of passages: their neighbours in time are training frames, the extreme
    of the movement is not. The combination is never in the training split.

    Args:
        names: the passage of each frame.
        test_frames: number of frames to hold out, fewer than all.
        block: frames per block, at least 1.
    """
    chosen = [i for i, name in enumerate(names) if name == COMBINATION][:test_frames]
    others: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if name != COMBINATION:
            others.setdefault(name, []).append(i)
    order = sorted(others.values(), key=len, reverse=True)
    while len(chosen) < test_frames:
        before = len(chosen)
        # one frame of each passage stays in training as long as possible
        for run in order:
            free = [i for i in run if i not in chosen]
            size = max(min(block, test_frames - len(chosen), len(free) - 1), 0)
            begin = (len(free) - size + 1) // 2
            chosen += free[begin : begin + size]
        if len(chosen) == before:
            left = [i for i in range(len(names)) if i not in chosen]
            chosen += left[: test_frames - len(chosen)]
    return sorted(chosen)
