"""Sign language in front of chest and face: twelve signs, of which three are never trained on.

Units and axes are those of :mod:`motions.controls`; knuckles are the middle fingers', in
mirrored chest axes from the middle of the shoulders: the mouth is at (0, -0.18, 0.16). The signs
are gestures with the hand shapes, contacts and occlusions of signs, and have no meaning.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from motions.controls import (
    TAU,
    Array,
    Controls,
    Programme,
    Style,
    place,
    rotate,
    smoothstep,
)

Value = Array | float  # a number, or one per frame [F]


STRAIGHT_FINGERS = (0.0,) * 5


class HandShape(NamedTuple):
    """The flexion of a hand's fingers, thumb first, as in `Controls`."""

    curl: tuple[float, ...]
    bend: tuple[float, ...] = STRAIGHT_FINGERS
    spread: float = 0.0


# Shapes of hands.
LOOSE_HAND = HandShape(
    curl=(0.2, 0.2, 0.25, 0.3, 0.35),
    spread=0.03,
)
FLAT_HAND = HandShape(
    curl=STRAIGHT_FINGERS,
    bend=(-1.0, 0, 0, 0, 0),
)
FAN_HAND = HandShape(
    curl=STRAIGHT_FINGERS,
    bend=(-0.8, 0, 0, 0, 0),
    spread=0.17,
)
FIST = HandShape(
    curl=(0.75, 0.95, 0.97, 1.0, 1.0),
)
INDEX_HAND = HandShape(
    curl=(0.8, 0.0, 0.95, 1.0, 1.0),
)
TWO = HandShape(
    curl=(0.8, 0.0, 0.0, 0.95, 1.0),
    spread=0.12,
)
OPEN = HandShape(
    curl=STRAIGHT_FINGERS,
    bend=(-1.0, 0, 0, 0, 0),
    spread=0.2,
)
CLASP = HandShape(
    curl=(0.0, 0.45, 0.45, 0.45, 0.45),
    bend=(-1.0, 0.03, 0.03, 0.03, 0.03),
    spread=0.28,
)
# Sides of the controls.
BOTH_HANDS = (0, 1)
LEFT_HAND = (0,)
RIGHT_HAND = (1,)


def at_ease(frames: int) -> Controls:
    """Hands rest before the belly: signs start and end there."""
    c = Controls(frames)
    c.elbow[...] = (0.8, 0.35, -1.0)
    _place(
        c,
        BOTH_HANDS,
        knuckle=(0.1, -0.31, -0.34),
        pointing=(-0.55, -0.85, 0.05),
        facing=(-0.85, 0.55, 0.1),
    )
    _shape(c, BOTH_HANDS, LOOSE_HAND)
    return c


def _place(
    c: Controls,
    sides: Sequence[int],
    knuckle: Sequence[Value],
    pointing: Sequence[Value],
    facing: Sequence[Value],
) -> None:
    """Places hands: x, y and z of the knuckle, of the hand's direction and of the palm's."""
    for side in sides:
        place(c.knuckle[:, side], *knuckle)
        place(c.pointing[:, side], *pointing)
        place(c.facing[:, side], *facing)


def _shape(
    c: Controls, sides: Sequence[int], shape: HandShape, share: Value = 1.0
) -> None:
    """Turns the fingers of hands to a shape, or by a share ``[F]`` of the way to it."""
    weight = np.broadcast_to(share, len(c.path))
    curl = np.array(shape.curl)
    bend = np.array(shape.bend)
    for side in sides:
        c.curl[:, side] += weight[:, None] * (curl - c.curl[:, side])
        c.bend[:, side] += weight[:, None] * (bend - c.bend[:, side])
        c.spread[:, side] += weight * (shape.spread - c.spread[:, side])


def _mix(
    share: Array, start: Sequence[float], end: Sequence[float]
) -> list[Array]:
    """From ``start`` to ``end`` by a share ``[F]``, axis by axis."""
    return [
        (1 - share) * a + share * b for a, b in zip(start, end, strict=True)
    ]


def _there(s: Array, start: float = 0.3, end: float = 0.7) -> Array:
    """0 until ``start``, 1 from ``end``."""
    return smoothstep((s - start) / (end - start))


def hello(c: Controls, s: Array, style: Style) -> None:
    """A flat hand from the temple outwards; the other one rests."""
    # The palm stays towards the front while the hand moves and tilts outwards.
    out = _there(s)
    _place(
        c,
        RIGHT_HAND,
        knuckle=_mix(out, (0.13, -0.21, 0.26), (0.33, -0.3, 0.24)),
        pointing=_mix(out, (-0.5, 0.1, 0.85), (0.25, -0.2, 1)),
        facing=(-0.1, -1, 0),
    )
    _shape(c, RIGHT_HAND, FLAT_HAND)

    # The elbow is outside; the mouth goes from wide to round.
    c.elbow[:, 1] = (1.0, 0.3, -0.9)
    c.set_face(
        smile=1,
        brows=0.7,
        wide=0.6 * (1 - out),
        round=0.7 * out,
    )


def mask(c: Controls, s: Array, style: Style) -> None:
    """An open hand passes before eyes and mouth, its fingers moving."""
    # The hand goes down from the eyes to the mouth.
    down = _there(s, 0.25, 0.8)
    _place(
        c,
        RIGHT_HAND,
        knuckle=_mix(down, (0.03, -0.28, 0.25), (0.02, -0.27, 0.1)),
        pointing=(-1, 0.1, 0.3),
        facing=(0, 1, 0),
    )
    _shape(c, RIGHT_HAND, FAN_HAND)

    # The fingers ripple, one after the other.
    for finger in range(1, 5):
        ripple = np.sin(TAU * 2 * s + style.phase + finger)
        c.bend[:, 1, finger] += 0.12 * ripple

    # The elbow hangs down; brows and mouth open.
    c.elbow[:, 1] = (0.5, 0.2, -1.0)
    c.set_face(brows=1, mouth=0.8)


def interlace(c: Controls, s: Array, style: Style) -> None:
    """Hands meet and their fingers interlace; the clasped hands sway."""
    # The hands come near, then the fingers close; they open before the hands part.
    near = _there(s, 0.1, 0.35) * (1 - _there(s, 0.68, 0.92))
    closed = _there(s, 0.3, 0.5) * (1 - _there(s, 0.55, 0.75))
    sway = 0.03 * style.amplitude * np.sin(TAU * s)
    for side, sign in zip(BOTH_HANDS, (1, -1), strict=True):
        # The hands are half a finger's width apart, so that fingers pass between fingers.
        across = 0.09 - 0.052 * near + sign * sway
        _place(
            c,
            (side,),
            knuckle=(across, -0.33 - 0.008 * sign, -0.1 - 0.005 * sign),
            pointing=(0, -0.5, 0.85),
            facing=(-1, 0, 0),
        )

    # Open hands close round each other; the elbows are outside.
    _shape(c, BOTH_HANDS, OPEN)
    _shape(c, BOTH_HANDS, CLASP, closed)
    c.elbow[...] = (1.0, 0.2, -0.8)
    c.set_face(round=0.9, brows=0.4)
    rotate(c.head, forwards=0.1 * closed)


def palms(c: Controls, s: Array, style: Style) -> None:
    """Palm on palm, rubbing."""
    # Each hand moves forwards where the other one moves back.
    rub = 0.02 * style.amplitude * np.sin(TAU * 2 * s + style.phase)
    for side, sign in zip(BOTH_HANDS, (1, -1), strict=True):
        _place(
            c,
            (side,),
            knuckle=(0.023, -0.34 + sign * rub, -0.1 - 0.4 * sign * rub),
            pointing=(-0.07, -0.6, 0.8),
            facing=(-1, 0, 0),
        )

    # The elbows are outside.
    _shape(c, BOTH_HANDS, FLAT_HAND)
    c.elbow[...] = (1.0, 0.2, -0.8)
    c.set_face(round=0.5, mouth=0.3, brows=-0.7)


def support(c: Controls, s: Array, style: Style) -> None:
    """A fist on the other hand's palm; both rise."""
    # The palm and the fist on it rise together.
    rise = -0.24 + 0.1 * _there(s, 0.25, 0.75)
    _place(
        c,
        LEFT_HAND,
        knuckle=(0.0, -0.33, rise),
        pointing=(-0.75, -0.65, 0),
        facing=(-0.4, 0.1, 0.9),
    )
    _place(
        c,
        RIGHT_HAND,
        knuckle=(-0.02, -0.33, rise + 0.1),
        pointing=(-0.8, -0.6, 0),
        facing=(-0.6, 0.8, 0),
    )

    # The lower hand is flat.
    _shape(c, LEFT_HAND, FLAT_HAND)
    _shape(c, RIGHT_HAND, FIST)
    c.set_face(wide=0.5, mouth=0.3, brows=0.5)


def point(c: Controls, s: Array, style: Style) -> None:
    """The index finger touches the other hand's palm, twice."""
    # The finger goes away from the palm and back, twice.
    back = 0.05 * np.sin(TAU * s) ** 2
    _place(
        c,
        LEFT_HAND,
        knuckle=(0.08, -0.33, -0.06),
        pointing=(-0.1, -0.5, 0.85),
        facing=(-1, 0, 0),
    )
    _place(
        c,
        RIGHT_HAND,
        knuckle=(0.04 + back, -0.31, -0.1),
        pointing=(-1, -0.15, 0.1),
        facing=(0, 0.3, -1),
    )

    # The touched hand is flat; the elbow of the other arm is outside.
    _shape(c, LEFT_HAND, FLAT_HAND)
    _shape(c, RIGHT_HAND, INDEX_HAND)
    c.elbow[:, 1] = (1.0, 0.1, -0.6)
    c.set_face(wide=0.8, brows=-1)


def hug(c: Controls, s: Array, style: Style) -> None:
    """Forearms crossed before the chest, the right one in front."""
    # The forearms cross, rock, and part.
    x = 0.1 - 0.22 * _there(s, 0.1, 0.3) * (1 - _there(s, 0.7, 0.9))
    rock = 0.02 * style.amplitude * np.sin(TAU * s)
    _place(
        c,
        LEFT_HAND,
        knuckle=(x + rock, -0.25, -0.02),
        pointing=(-0.8, 0.05, 0.6),
        facing=(0, 1, 0),
    )
    _place(
        c,
        RIGHT_HAND,
        knuckle=(x - rock, -0.34, -0.02),
        pointing=(-0.8, 0.05, 0.6),
        facing=(0, 1, 0),
    )

    # The hands are fists, and the head rocks with the arms.
    _shape(c, BOTH_HANDS, FIST)
    c.elbow[...] = (0.8, -0.2, -1.0)
    c.set_face(smile=1, mouth=0.2)
    rotate(c.head, sideways=0.15 * np.sin(TAU * s))


def turn(c: Controls, s: Array, style: Style) -> None:
    """Index fingers circle round each other."""
    # The fingers are on opposite sides of a circle.
    for side, shift in zip(BOTH_HANDS, (0.0, TAU / 2), strict=True):
        angle = TAU * 2 * s + style.phase + shift
        ahead = -0.34 + 0.055 * np.cos(angle)
        height = -0.08 + 0.055 * np.sin(angle)
        _place(
            c,
            (side,),
            knuckle=(0.05, ahead, height),
            pointing=(-1, -0.2, 0.05),
            facing=(-0.2, 1, 0),
        )

    # The mouth opens and closes three times meanwhile.
    _shape(c, BOTH_HANDS, INDEX_HAND)
    c.elbow[...] = (1.0, 0.1, -0.8)
    c.set_face(
        mouth=0.9 * np.sin(TAU * 1.5 * s) ** 2,
        brows=0.3,
    )


def look(c: Controls, s: Array, style: Style) -> None:
    """Two fingers go from before the eyes forwards."""
    # The hand goes from the eyes to the front.
    out = _there(s)
    _place(
        c,
        RIGHT_HAND,
        knuckle=_mix(out, (0.06, -0.3, 0.2), (0.02, -0.45, 0.08)),
        pointing=_mix(out, (-0.4, -0.3, 0.9), (-0.25, -0.8, 0.45)),
        facing=(-0.2, -0.8, -0.6),
    )
    _shape(c, RIGHT_HAND, TWO)
    c.set_face(brows=-0.9, round=0.6)
    rotate(c.head, forwards=0.1 * out)


def roof(c: Controls, s: Array, style: Style) -> None:
    """Finger tips touch as a roof; then the hands go down as walls."""
    # The palms turn towards each other while the hands go down.
    down = _there(s, 0.4, 0.7)
    _place(
        c,
        BOTH_HANDS,
        knuckle=_mix(down, (0.081, -0.32, 0.0), (0.13, -0.32, -0.16)),
        pointing=_mix(down, (-0.7, -0.15, 0.7), (0, -0.5, 0.85)),
        facing=_mix(down, (-0.7, 0, -0.7), (-1, 0, 0)),
    )
    _shape(c, BOTH_HANDS, FLAT_HAND)
    c.elbow[...] = (1.0, 0.2, -0.8)
    c.set_face(mouth=0.4, round=0.4 * down, brows=0.6)


def cancel(c: Controls, s: Array, style: Style) -> None:
    """Spread hands cross and part, twice, the left one in front; the head shakes."""
    # The hands cross twice, one in front of the other.
    x = 0.05 + 0.1 * np.cos(TAU * 2 * s)
    _place(
        c,
        LEFT_HAND,
        knuckle=(x, -0.41, -0.07),
        pointing=(-0.5, -0.2, 0.8),
        facing=(-0.7, -0.7, 0),
    )
    _place(
        c,
        RIGHT_HAND,
        knuckle=(x, -0.31, -0.01),
        pointing=(-0.5, -0.2, 0.8),
        facing=(-0.7, -0.7, 0),
    )

    # The head shakes as often as the hands cross.
    _shape(c, BOTH_HANDS, OPEN)
    c.set_face(wide=0.9, brows=-0.8)
    rotate(c.head, turn=0.25 * np.sin(TAU * 2 * s))


def peek(c: Controls, s: Array, style: Style) -> None:
    """Both hands cover the eyes, and open to the sides."""
    # The hands part, and their fingers spread.
    open_ = _there(s, 0.45, 0.7)
    _place(
        c,
        BOTH_HANDS,
        knuckle=_mix(open_, (0.066, -0.28, 0.19), (0.22, -0.28, 0.19)),
        pointing=(-0.12, 0.05, 1),
        facing=(-0.2, 1, 0),
    )
    _shape(c, BOTH_HANDS, FLAT_HAND)
    _shape(c, BOTH_HANDS, FAN_HAND, open_)

    # The face frowns while it is covered, and smiles afterwards.
    c.elbow[...] = (1.0, -0.1, -0.9)
    c.set_face(
        smile=open_,
        mouth=0.7 * open_,
        brows=2 * open_ - 1,
    )


SIGNS = Programme(
    (
        ("hello", hello, 1.6),
        ("mask", mask, 2.0),
        ("interlace", interlace, 2.4),
        ("roof", roof, 2.0),
        ("palms", palms, 2.0),
        ("support", support, 2.0),
        ("cancel", cancel, 2.2),
        ("point", point, 2.0),
        ("hug", hug, 2.2),
        ("peek", peek, 1.8),
        ("turn", turn, 2.2),
        ("look", look, 1.6),
    ),
    resting=at_ease,
    blend=0.4,
)
