"""The everyday choreography: passages from walking to a free style.

Units and axes are those of :mod:`motions.controls`. Passages write into neutral controls
``c``, given times ``s [F]`` in [0, 1] through the passage.
"""

import math

import numpy as np
from motions.controls import (
    TAU,
    WALK,
    Array,
    Controls,
    Passage,
    Programme,
    Style,
    place,
    rotate,
    smoothstep,
)

from gsgan.synthetic.passages import COMBINATION


def walk(c: Controls, s: Array, style: Style) -> None:
    """Walking round an oval, and back to the start after a full turn to the left."""
    angle = TAU * _ease(s)
    cosine = np.cos(angle)
    sine = np.sin(angle)

    # The heading follows the oval, without jumps of a full turn.
    ahead = 0.3 * cosine**2 + 0.2 * sine**2
    heading = angle - np.arctan2(0.1 * sine * cosine, ahead)
    place(
        c.path,
        x=0.2 * (1 - cosine),
        y=-0.3 * sine,
        z=heading,
    )

    # The arms swing with the legs, and the head turns with the curve.
    c.swing[:] = style.amplitude
    rotate(c.head, turn=0.25 * sine)
    c.set_face(smile=0.3)


def _ease(s: Array, share: float = 0.12) -> Array:
    """From 0 to 1 at constant speed, which starts and ends smoothly."""

    def begin(x: Array) -> Array:
        u = (x / share).clip(0, 1)
        start = share * (u**3 - u**4 / 2)
        return start + (x - share).clip(0)

    from_end = 1 - share - begin(1 - s)
    return np.where(s < 0.5, begin(s), from_end) / (1 - share)


def arm_swings(c: Controls, s: Array, style: Style) -> None:
    """Straight arms swung forwards, sideways and back, out of step."""
    length = 0.55
    for i, shift in enumerate((0.0, 0.35)):
        # Angle of the arm from hanging down, and its share sideways.
        swing = 0.5 - 0.5 * np.cos(TAU * (s - 0.2 * shift))
        around = TAU * 1.5 * s + style.phase + shift * TAU
        angle = 1.55 * style.amplitude * swing
        out = 0.5 + 0.5 * np.sin(around)

        reach = length * np.sin(angle)
        place(
            c.wrist[:, i],
            x=0.10 + reach * out,
            y=-0.04 - reach * (1 - out),
            z=-length * np.cos(angle),
        )
    rotate(c.spine, forwards=-0.12 * np.sin(TAU * s))


def wave(c: Controls, s: Array, style: Style) -> None:
    """One hand waves beside the head, the other is on the hip."""
    phase = TAU * 3 * s + style.phase
    _wave_arm(c, style.lead, phase, style.amplitude)

    # The other hand, a loose fist on the hip.
    other = 1 - style.lead
    c.wrist[:, other] = (0.13, -0.04, -0.36)
    c.elbow[:, other] = (1.0, 0.6, 0.0)
    c.curl[:, other] = 0.8

    # The head turns towards the waving hand.
    turn = 0.3 if style.lead == 0 else -0.3
    rotate(c.head, turn=turn * np.sin(math.pi * s))
    speech = _wander(s, 3, style.phase)
    c.set_face(
        smile=1,
        brows=0.6,
        mouth=0.25 * speech.clip(0),
    )


def _wave_arm(c: Controls, side: int, phase: Array, amplitude: float) -> None:
    """An open hand beside the head, waving sideways."""
    place(
        c.wrist[:, side],
        x=0.24 + 0.12 * amplitude * np.sin(phase),
        y=-0.16,
        z=0.26,
    )
    c.elbow[:, side] = (1.0, 0.4, -0.9)
    c.palm[:, side] = -0.6
    c.curl[:, side] = 0.05


def squat(c: Controls, s: Array, style: Style) -> None:
    """Two squats, arms reaching forwards for balance."""
    depth = 0.5 - 0.5 * np.cos(TAU * 2 * s)
    _squat_legs(c, depth, style.amplitude)
    for i in range(2):
        place(
            c.wrist[:, i],
            x=0.10 - 0.04 * depth,
            y=-0.04 - 0.44 * depth,
            z=-0.5 + 0.44 * depth,
        )


def _squat_legs(c: Controls, depth: Array, amplitude: float) -> None:
    """A squat of a depth ``[F]`` in [0, 1]: hips back and down, the trunk forwards."""
    c.pelvis[:, 2] += -0.36 * amplitude * depth
    c.pelvis[:, 1] += 0.16 * amplitude * depth
    rotate(c.lean, forwards=0.45 * amplitude * depth)
    rotate(c.spine, forwards=0.15 * depth)
    rotate(c.head, forwards=-0.35 * depth)
    c.foot[:, :, 0] += 0.06


def overhead(c: Controls, s: Array, style: Style) -> None:
    """Both arms rise to above the head and circle there."""
    rise = np.sin(math.pi * s) ** 2
    for i, shift in enumerate((0.0, 1.3)):
        circle = TAU * 2 * s + style.phase + shift
        # Angle of the arm from hanging down; raised arms are shorter, so that they are bent.
        angle = rise * 2.75 * (0.92 + 0.08 * style.amplitude)
        height = np.cos(angle)
        place(
            c.wrist[:, i],
            x=0.10 + 0.42 * np.sin(angle) + 0.05 * np.cos(circle) * rise,
            y=-0.06 + 0.08 * np.sin(circle) * rise,
            z=np.where(height > 0, -0.48, -0.36) * height,
        )
        c.elbow[:, i] = (1.0, 0.9, -0.1)

    # Hands open and the gaze rises with the arms.
    c.curl[...] = (0.25 - 0.2 * rise)[:, None, None]
    rotate(c.head, forwards=-0.2 * rise)
    c.set_face(
        mouth=0.5 * rise,
        brows=rise,
    )


def twist(c: Controls, s: Array, style: Style) -> None:
    """The trunk turns and leans from side to side, bent arms held out."""
    # The head turns less than the trunk.
    turn = np.sin(TAU * 1.5 * s + 0.3 * style.phase)
    rotate(
        c.spine,
        sideways=0.35 * np.sin(TAU * s + style.phase),
        turn=0.75 * style.amplitude * turn,
    )
    rotate(c.head, turn=-0.4 * turn)

    # The arms, one ahead of the other as the trunk turns.
    for i, sign in enumerate((1.0, -1.0)):
        place(
            c.wrist[:, i],
            x=0.22 + 0.06 * sign * turn,
            y=-0.30,
            z=-0.12 + 0.10 * sign * turn,
        )
        c.elbow[:, i] = (1.0, 0.5, -0.5)
    c.curl[...] = 0.75
    c.set_face(brows=-0.7)


def reach(c: Controls, s: Array, style: Style) -> None:
    """One hand reaches high to its side, then low across the body; the gaze follows."""
    low = smoothstep((s - 0.35) / 0.3)
    high = 1 - low
    side = style.lead
    sign = 1.0 if side == 0 else -1.0

    # The reaching arm; its hand closes on the way.
    place(
        c.wrist[:, side],
        x=0.3 * high - 0.06 * low,
        y=-0.2 * high - 0.42 * low,
        z=0.4 * high - 0.3 * low,
    )
    c.elbow[:, side] = (1.0, 0.5, -0.6)
    c.palm[:, side] = 0.5 * low - 0.5 * high
    grasp = np.exp(-(((s - 0.4) / 0.1) ** 2))
    c.curl[:, side] = (0.15 + 0.6 * grasp)[:, None]

    # The trunk bends and turns with the arm.
    rotate(
        c.spine,
        forwards=0.45 * low - 0.1 * high,
        sideways=-0.2 * sign * high,
        turn=-0.5 * sign * low + 0.25 * sign * high,
    )
    rotate(c.lean, forwards=0.2 * low)
    c.pelvis[:, 1:] += low[:, None] * (0.1, -0.1)

    # The gaze follows the hand.
    rotate(
        c.head,
        forwards=0.15 * low - 0.35 * high,
        turn=sign * (0.4 * high - 0.15 * low),
    )
    c.set_face(mouth=0.15 * high)


def signing(c: Controls, s: Array, style: Style) -> None:
    """Sign language in front of the chest, every finger with its own rhythm."""
    _sign_arms(c, s, style)
    rotate(
        c.head,
        forwards=0.12 * np.sin(TAU * 2.5 * s + 1),
        turn=0.2 * np.sin(TAU * 1.5 * s),
    )


def _sign_arms(c: Controls, s: Array, style: Style) -> None:
    """Arms, fingers and face of `signing`."""
    for i, shift in enumerate((0.0, 2.1)):
        # The hand circles before the chest.
        angle = TAU * s + style.phase + shift
        place(
            c.wrist[:, i],
            x=0.02 + 0.1 * np.sin(2 * angle),
            y=-0.31 - 0.06 * style.amplitude * np.sin(3 * angle + 1),
            z=-0.15 + 0.14 * style.amplitude * np.sin(3 * angle),
        )
        c.elbow[:, i] = (0.8, 0.3, -1.0)
        c.palm[:, i] = 0.1 + 0.7 * np.sin(2 * angle + 0.5)
        c.flex[:, i] = 0.25 * np.sin(3 * angle + 2)

        # Neighbouring fingers bend at different frequencies.
        for finger in range(5):
            frequency = 2 + finger % 3
            bent = np.sin(frequency * angle + 1.7 * finger)
            c.curl[:, i, finger] = 0.45 + 0.45 * bent

    # Mouthing goes with signs.
    smile = _wander(s, 2, style.phase)
    c.set_face(
        mouth=0.3 + 0.45 * _wander(s, 9, style.phase),
        smile=0.3 * smile.clip(0),
        brows=0.9 * _wander(s, 3, style.phase + 1),
    )


def squat_and_wave(c: Controls, s: Array, style: Style) -> None:
    """The held-out combination: a half squat while one hand waves and the other signs."""
    _sign_arms(c, s, style)
    depth = 0.65 * np.sin(math.pi * s) ** 2
    _squat_legs(c, depth, style.amplitude)
    # The waving hand replaces one of the signing hands.
    phase = TAU * 2 * s + style.phase
    _wave_arm(c, style.lead, phase, style.amplitude)
    rotate(c.spine, turn=0.4 * np.sin(TAU * s))


def dance(c: Controls, s: Array, style: Style) -> None:
    """Steps from side to side with high knees, hips and arms in the same beat."""
    beat = TAU * 3 * s
    swing = np.sin(beat)

    # The steps.
    sway = np.sin(TAU * s)
    c.march[:] = 0.16 * style.amplitude
    c.path[:, 0] = 0.12 * sway
    c.path[:, 2] = 0.4 * style.amplitude * sway

    # The trunk.
    c.pelvis[:, 2] += -0.05 + 0.02 * np.cos(2 * beat)
    rotate(c.lean, sideways=0.08 * swing)
    rotate(
        c.spine,
        sideways=-0.2 * swing,
        turn=0.3 * np.sin(beat + 0.8),
    )

    # The arms.
    for i, sign in enumerate((1.0, -1.0)):
        place(
            c.wrist[:, i],
            x=0.20 + 0.06 * sign * swing,
            y=-0.26 - 0.08 * sign * swing,
            z=-0.08 + 0.2 * np.sin(beat / 2 + sign + style.phase),
        )
        c.elbow[:, i] = (1.0, 0.6, -0.5)
        c.palm[:, i] = 0.4 * np.sin(beat + sign)
    c.curl[...] = 0.5
    c.set_face(smile=0.9)


def freestyle(c: Controls, s: Array, style: Style) -> None:
    """Arms, trunk, legs and heading move independently: poses that no other passage has.

    A model trained on the other passages alone is worst on poses between them.
    """
    phase = style.phase
    for i, shift in enumerate((0.0, 2.6)):
        _free_arm(c, i, s, phase + shift, style.amplitude)
        # The feet, metres from standing.
        c.foot[:, i, 0] = 0.04 + 0.04 * _wander(s, 1.9, phase + shift + 0.7)
        c.foot[:, i, 1] = 0.18 * _wander(s, 2.2, phase + shift + 2.2)

    # The square keeps the squat shallow most of the time.
    depth = 0.6 * (0.5 + 0.5 * _wander(s, 2, phase + 6)) ** 2
    _squat_legs(c, depth, style.amplitude)

    # Trunk, head and heading.
    rotate(
        c.spine,
        forwards=0.2 * _wander(s, 2.3, phase + 3.5),
        sideways=0.3 * _wander(s, 2.6, phase + 2.5),
        turn=0.6 * _wander(s, 2.1, phase + 1.5),
    )
    rotate(
        c.head,
        forwards=0.15 * _wander(s, 3.4, phase + 5.5),
        turn=-0.3 * _wander(s, 2.9, phase + 4.5),
    )
    c.path[:, 2] = 0.9 * _wander(s, 1.4, phase + 0.5)

    # The face changes on its own too.
    c.set_face(
        mouth=0.5 * _wander(s, 6, phase + 7),
        smile=0.8 * _wander(s, 2, phase + 8),
        brows=0.9 * _wander(s, 3, phase + 9),
    )


def _free_arm(
    c: Controls, side: int, s: Array, phase: float, amplitude: float
) -> None:
    """An arm of `freestyle`, in spherical coordinates about the shoulder."""
    # From 0 (down) to half a turn (up), and from 0 (in front) to a quarter turn (sideways).
    rise = 1.25 + 1.1 * amplitude * _wander(s, 2.5, phase)
    around = 0.75 + 0.7 * _wander(s, 3.2, phase + 1)
    radius = 0.42 + 0.09 * _wander(s, 3.7, phase + 2)
    height = np.sin(rise)
    place(
        c.wrist[:, side],
        x=0.06 + radius * height * np.sin(around),
        y=-0.04 - radius * height.clip(0.1) * np.cos(around),
        z=-radius * np.cos(rise),
    )
    c.elbow[:, side] = (1.0, 0.6, -0.5)

    # Forearm, wrist and fingers.
    c.palm[:, side] = 0.6 * _wander(s, 2.8, phase + 3)
    c.flex[:, side] = 0.25 * _wander(s, 3.5, phase + 4)
    for finger in range(5):
        bent = _wander(s, 4, phase + 5 + 0.9 * finger)
        c.curl[:, side, finger] = 0.45 + 0.4 * bent


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
