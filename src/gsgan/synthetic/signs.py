"""Sign language in front of chest and face: twelve signs, of which three are never trained on.

Convention: that of :mod:`gsgan.synthetic.controls`; knuckles are the middle fingers', in
mirrored chest axes from the middle of the shoulders: the mouth is at (0, -0.18, 0.16). The signs
are gestures with the hand shapes, contacts and occlusions of signs, and have no meaning.
"""

from collections.abc import Sequence

import numpy as np

from gsgan.synthetic.controls import TAU, Array, Controls, Programme, Style, smoothstep
from gsgan.utils.errors import ConfigError

# Hand shapes: curl of each finger, thumb first; bend of its first joint besides; spread.
Shape = tuple[tuple[float, ...], tuple[float, ...], float]
STRAIGHT = (0.0,) * 5
LOOSE: Shape = ((0.2, 0.2, 0.25, 0.3, 0.35), STRAIGHT, 0.03)
FLAT: Shape = (STRAIGHT, (-1.0, 0, 0, 0, 0), 0.0)
FAN: Shape = (STRAIGHT, (-0.8, 0, 0, 0, 0), 0.17)
FIST: Shape = ((0.75, 0.95, 0.97, 1.0, 1.0), STRAIGHT, 0.0)
INDEX: Shape = ((0.8, 0.0, 0.95, 1.0, 1.0), STRAIGHT, 0.0)
TWO: Shape = ((0.8, 0.0, 0.0, 0.95, 1.0), STRAIGHT, 0.12)
OPEN: Shape = (STRAIGHT, (-1.0, 0, 0, 0, 0), 0.2)
CLASP: Shape = ((0.0, 0.45, 0.45, 0.45, 0.45), (-1.0, 0.03, 0.03, 0.03, 0.03), 0.28)
BOTH = (0, 1)
LEFT = (0,)
RIGHT = (1,)


def at_ease(frames: int) -> Controls:
    """Hands rest before the belly: signs start and end there."""
    c = Controls(frames)
    c.elbow[...] = (0.8, 0.35, -1.0)
    _place(c, BOTH, (0.1, -0.31, -0.34), (-0.55, -0.85, 0.05), (-0.85, 0.55, 0.1))
    _shape(c, BOTH, LOOSE)
    return c


def _place(
    c: Controls,
    sides: Sequence[int],
    knuckle: Sequence[Array | float],
    pointing: Sequence[Array | float],
    facing: Sequence[Array | float],
) -> None:
    """Places hands: numbers, or arrays ``[F]``, for x, y and z."""
    for side in sides:
        for axis in range(3):
            c.knuckle[:, side, axis] = knuckle[axis]
            c.pointing[:, side, axis] = pointing[axis]
            c.facing[:, side, axis] = facing[axis]


def _shape(
    c: Controls, sides: Sequence[int], shape: Shape, share: Array | float = 1.0
) -> None:
    """Turns the fingers of hands to a shape, or by a share ``[F]`` of the way to it."""
    curl, bend, spread = shape
    w = np.broadcast_to(share, len(c.path))[:, None]
    for side in sides:
        c.curl[:, side] += w * (np.array(curl) - c.curl[:, side])
        c.bend[:, side] += w * (np.array(bend) - c.bend[:, side])
        c.spread[:, side] += w[:, 0] * (spread - c.spread[:, side])


def _mix(share: Array, a: Sequence[float], b: Sequence[float]) -> list[Array]:
    """From ``a`` to ``b`` by a share ``[F]``, axis by axis."""
    return [(1 - share) * x + share * y for x, y in zip(a, b, strict=True)]


def _there(s: Array, start: float = 0.3, end: float = 0.7) -> Array:
    """0 until ``start``, 1 from ``end``."""
    return smoothstep((s - start) / (end - start))


def hello(c: Controls, s: Array, style: Style) -> None:
    """A flat hand from the temple outwards; the other one rests."""
    out = _there(s)
    knuckle = _mix(out, (0.13, -0.21, 0.26), (0.33, -0.3, 0.24))
    _place(
        c, RIGHT, knuckle, _mix(out, (-0.5, 0.1, 0.85), (0.25, -0.2, 1)), (-0.1, -1, 0)
    )
    _shape(c, RIGHT, FLAT)
    c.elbow[:, 1] = (1.0, 0.3, -0.9)
    c.smile[:] = 1
    c.brows[:] = 0.7
    c.wide[:] = 0.6 * (1 - out)
    c.round[:] = 0.7 * out


def mask(c: Controls, s: Array, style: Style) -> None:
    """An open hand passes before eyes and mouth, its fingers moving."""
    down = _there(s, 0.25, 0.8)
    _place(
        c,
        RIGHT,
        _mix(down, (0.03, -0.28, 0.25), (0.02, -0.27, 0.1)),
        (-1, 0.1, 0.3),
        (0, 1, 0),
    )
    _shape(c, RIGHT, FAN)
    for finger in range(1, 5):
        ripple = np.sin(TAU * 2 * s + style.phase + finger)
        c.bend[:, 1, finger] += 0.12 * ripple
    c.elbow[:, 1] = (0.5, 0.2, -1.0)
    c.brows[:] = 1
    c.mouth[:] = 0.8


def interlace(c: Controls, s: Array, style: Style) -> None:
    """Hands meet and their fingers interlace; the clasped hands sway."""
    near = _there(s, 0.1, 0.35) * (1 - _there(s, 0.68, 0.92))
    closed = _there(s, 0.3, 0.5) * (1 - _there(s, 0.55, 0.75))
    sway = 0.03 * style.amplitude * np.sin(TAU * s)
    for side, sign in zip(BOTH, (1, -1), strict=True):
        # half a finger's width apart, so that fingers pass between fingers
        knuckle = (
            0.09 - 0.052 * near + sign * sway,
            -0.33 - 0.008 * sign,
            -0.1 - 0.005 * sign,
        )
        _place(c, (side,), knuckle, (0, -0.5, 0.85), (-1, 0, 0))
    _shape(c, BOTH, OPEN)
    _shape(c, BOTH, CLASP, closed)
    c.elbow[...] = (1.0, 0.2, -0.8)
    c.round[:] = 0.9
    c.brows[:] = 0.4
    c.head[:, 0] = 0.1 * closed


def palms(c: Controls, s: Array, style: Style) -> None:
    """Palm on palm, rubbing."""
    rub = 0.02 * style.amplitude * np.sin(TAU * 2 * s + style.phase)
    for side, sign in zip(BOTH, (1, -1), strict=True):
        knuckle = (0.023, -0.34 + sign * rub, -0.1 - 0.4 * sign * rub)
        _place(c, (side,), knuckle, (-0.07, -0.6, 0.8), (-1, 0, 0))
    _shape(c, BOTH, FLAT)
    c.elbow[...] = (1.0, 0.2, -0.8)
    c.round[:] = 0.5
    c.mouth[:] = 0.3
    c.brows[:] = -0.7


def support(c: Controls, s: Array, style: Style) -> None:
    """A fist on the other hand's palm; both rise."""
    rise = -0.24 + 0.1 * _there(s, 0.25, 0.75)
    _place(c, LEFT, (0.0, -0.33, rise), (-0.75, -0.65, 0), (-0.4, 0.1, 0.9))
    _place(c, RIGHT, (-0.02, -0.33, rise + 0.1), (-0.8, -0.6, 0), (-0.6, 0.8, 0))
    _shape(c, LEFT, FLAT)
    _shape(c, RIGHT, FIST)
    c.wide[:] = 0.5
    c.mouth[:] = 0.3
    c.brows[:] = 0.5


def point(c: Controls, s: Array, style: Style) -> None:
    """The index finger touches the other hand's palm, twice."""
    back = 0.05 * np.sin(TAU * s) ** 2
    _place(c, LEFT, (0.08, -0.33, -0.06), (-0.1, -0.5, 0.85), (-1, 0, 0))
    _place(c, RIGHT, (0.04 + back, -0.31, -0.1), (-1, -0.15, 0.1), (0, 0.3, -1))
    _shape(c, LEFT, FLAT)
    _shape(c, RIGHT, INDEX)
    c.elbow[:, 1] = (1.0, 0.1, -0.6)
    c.wide[:] = 0.8
    c.brows[:] = -1


def hug(c: Controls, s: Array, style: Style) -> None:
    """Forearms crossed before the chest, the right one in front."""
    x = 0.1 - 0.22 * _there(s, 0.1, 0.3) * (1 - _there(s, 0.7, 0.9))
    rock = 0.02 * style.amplitude * np.sin(TAU * s)
    _place(c, LEFT, (x + rock, -0.25, -0.02), (-0.8, 0.05, 0.6), (0, 1, 0))
    _place(c, RIGHT, (x - rock, -0.34, -0.02), (-0.8, 0.05, 0.6), (0, 1, 0))
    _shape(c, BOTH, FIST)
    c.elbow[...] = (0.8, -0.2, -1.0)
    c.smile[:] = 1
    c.mouth[:] = 0.2
    c.head[:, 1] = 0.15 * np.sin(TAU * s)


def turn(c: Controls, s: Array, style: Style) -> None:
    """Index fingers circle round each other."""
    for side, shift in zip(BOTH, (0.0, TAU / 2), strict=True):
        a = TAU * 2 * s + style.phase + shift
        knuckle = (0.05, -0.34 + 0.055 * np.cos(a), -0.08 + 0.055 * np.sin(a))
        _place(c, (side,), knuckle, (-1, -0.2, 0.05), (-0.2, 1, 0))
    _shape(c, BOTH, INDEX)
    c.elbow[...] = (1.0, 0.1, -0.8)
    c.mouth[:] = 0.9 * np.sin(TAU * 1.5 * s) ** 2
    c.brows[:] = 0.3


def look(c: Controls, s: Array, style: Style) -> None:
    """Two fingers go from before the eyes forwards."""
    out = _there(s)
    knuckle = _mix(out, (0.06, -0.3, 0.2), (0.02, -0.45, 0.08))
    _place(
        c,
        RIGHT,
        knuckle,
        _mix(out, (-0.4, -0.3, 0.9), (-0.25, -0.8, 0.45)),
        (-0.2, -0.8, -0.6),
    )
    _shape(c, RIGHT, TWO)
    c.brows[:] = -0.9
    c.round[:] = 0.6
    c.head[:, 0] = 0.1 * out


def roof(c: Controls, s: Array, style: Style) -> None:
    """Finger tips touch as a roof; then the hands go down as walls."""
    down = _there(s, 0.4, 0.7)
    knuckle = _mix(down, (0.081, -0.32, 0.0), (0.13, -0.32, -0.16))
    pointing = _mix(down, (-0.7, -0.15, 0.7), (0, -0.5, 0.85))
    _place(c, BOTH, knuckle, pointing, _mix(down, (-0.7, 0, -0.7), (-1, 0, 0)))
    _shape(c, BOTH, FLAT)
    c.elbow[...] = (1.0, 0.2, -0.8)
    c.mouth[:] = 0.4
    c.round[:] = 0.4 * down
    c.brows[:] = 0.6


def cancel(c: Controls, s: Array, style: Style) -> None:
    """Spread hands cross and part, twice, the left one in front; the head shakes."""
    x = 0.05 + 0.1 * np.cos(TAU * 2 * s)
    _place(c, LEFT, (x, -0.41, -0.07), (-0.5, -0.2, 0.8), (-0.7, -0.7, 0))
    _place(c, RIGHT, (x, -0.31, -0.01), (-0.5, -0.2, 0.8), (-0.7, -0.7, 0))
    _shape(c, BOTH, OPEN)
    c.wide[:] = 0.9
    c.brows[:] = -0.8
    c.head[:, 2] = 0.25 * np.sin(TAU * 2 * s)


def peek(c: Controls, s: Array, style: Style) -> None:
    """Both hands cover the eyes, and open to the sides."""
    open_ = _there(s, 0.45, 0.7)
    knuckle = _mix(open_, (0.066, -0.28, 0.19), (0.22, -0.28, 0.19))
    _place(c, BOTH, knuckle, (-0.12, 0.05, 1), (-0.2, 1, 0))
    _shape(c, BOTH, FLAT)
    _shape(c, BOTH, FAN, open_)
    c.elbow[...] = (1.0, -0.1, -0.9)
    c.smile[:] = open_
    c.mouth[:] = 0.7 * open_
    c.brows[:] = 2 * open_ - 1


# a contact, a crossing, and hands before the face
HELD_OUT = ("roof", "cancel", "peek")
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


def split_signs(names: Sequence[str], test_frames: int) -> tuple[list[int], list[int]]:
    """Training and held-out frames: signs in `HELD_OUT` are whole in the held-out split.

    Frames of these signs beyond ``test_frames`` are in neither split.

    Args:
        names: the sign of each frame.
        test_frames: number of frames to hold out; 0: all signs train.

    Raises:
        ConfigError: when the signs in `HELD_OUT` have fewer frames.
    """
    unseen = [i for i, name in enumerate(names) if name in HELD_OUT]
    if test_frames > len(unseen):
        raise ConfigError(
            f"synthetic data: motion=signs holds out the signs {', '.join(HELD_OUT)}, which have "
            f"{len(unseen)} of {len(names)} frames; test_frames must be at most that"
        )
    if test_frames == 0:
        return list(range(len(names))), []
    test = [unseen[k * len(unseen) // test_frames] for k in range(test_frames)]
    return [i for i in range(len(names)) if i not in unseen], test
