"""Pose sequences through the singularities of the bone frames, with bounds on how fast frames turn.

A frame whose baseline is ``h`` long turns by about ``step / h`` when a joint makes a step; so below
`MIN_LENGTH` (1 mm) it may turn by a few ``step / MIN_LENGTH``, and never by more: that is what
passing a singularity without a jump means. A path straight through the point where a baseline
changes sign turns by half a turn within a few millimetres: fast, but not at once.
"""

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.frames import MIN_LENGTH
from stability.cases.poses import rest

Path = Callable[[Tensor], Tensor]


def poses(path: Path, steps: int) -> Tensor:
    """``[steps, 33, 3]`` evenly along a path; its middle is one of them where steps are odd."""
    return path(torch.linspace(-1, 1, steps, dtype=torch.float64))


def _vector(*xyz: float) -> Tensor:
    return torch.tensor(xyz, dtype=torch.float64)


def _through(s: Tensor, count: float, *direction: float) -> Tensor:
    """``[T, 3]``: so many lengths of 1 mm to either side of zero, along a direction."""
    return (
        count * MIN_LENGTH * s[:, None] * normalize(_vector(*direction), dim=0)
    )


def _line(p: Tensor, joints: tuple[int, int], half: Tensor) -> None:
    """Puts the two joints ``half [T, 3]`` to either side of their middle."""
    middle = p[:, list(joints)].mean(1)
    p[:, joints[0]], p[:, joints[1]] = middle + half, middle - half


def _shrinking_forearm(s: Tensor) -> Tensor:
    p = rest(len(s))
    p[:, 15] = p[:, 13] + _through(s, 3, -0.8, -0.5, 0.3)
    return p


def _bending_arm(
    s: Tensor, around: float = 0.0, across: float = 0.0, reach: float = 0.1
) -> Tensor:
    """The forearm turns ``reach`` radians to either side of ``around`` radians off straight.

    It bends about the elbow's hinge, forwards where positive, and passes ``around`` at a distance
    of ``across`` radians.
    """
    p = rest(len(s))
    upper = _vector(*MEDIAPIPE33.rest_directions[0])
    hinge = normalize(_vector(-1, 0, 0) + upper[0] * upper, dim=0)
    front = torch.linalg.cross(hinge, upper)
    angle = (around + reach * s)[:, None]
    d = angle.cos() * upper + angle.sin() * front + across * hinge
    p[:, 13] = p[:, 11] + 0.28 * upper
    p[:, 15] = p[:, 13] + 0.25 * normalize(d, dim=-1)
    p[:, [17, 19, 21]] += p[:, 15:16] - rest()[:, 15:16]
    return p


def _shoulders_through_the_spine(
    s: Tensor, direction: tuple[float, float, float]
) -> Tensor:
    """The shoulder line, along the spine but for a part that passes zero."""
    p = rest(len(s))
    _line(p, (11, 12), _vector(0, 0.15, 0) + _through(s, 2, *direction))
    return p


def _left_and_right_change_places(s: Tensor) -> Tensor:
    p = rest(len(s))
    for joints in ((23, 24), (11, 12)):
        _line(p, joints, _through(s, 2, 0.8, 0.0, -0.6))
    return p


def _hips_through_the_shoulders(s: Tensor) -> Tensor:
    """The spine passes zero, obliquely to the world's y axis."""
    p = rest(len(s))
    shift = p[:, [23, 24]].mean(1) - p[:, [11, 12]].mean(1)
    shift = shift + _through(s, 4, 0.1, 0.6, 0.8)
    p[:, [11, 12]] = p[:, [11, 12]] + shift[:, None]
    return p


def _nose_through_the_ears(s: Tensor) -> Tensor:
    p = rest(len(s))
    p[:, 0] = p[:, [7, 8]].mean(1) + _through(s, 4, 0, 0, 1)
    return p


def _ears_through_each_other(s: Tensor) -> Tensor:
    p = rest(len(s))
    _line(p, (7, 8), _through(s, 2, 0.5, 0.6, 0.6))
    return p


def _shoulders_round_the_hips(s: Tensor) -> Tensor:
    """All above the hips turns about the vertical."""
    p = rest(len(s))
    angle = math.pi + 0.2 * s
    cos, sin, zero = angle.cos(), angle.sin(), torch.zeros_like(s)
    turn = torch.stack(
        [cos, zero, sin, zero, zero + 1, zero, -sin, zero, cos], dim=-1
    )
    p[:, :23] = p[:, :23] @ turn.unflatten(-1, (3, 3)).mT
    return p


_EYES = "Below 1 mm the eyes' frame takes over."

CROSSINGS: dict[str, tuple[Path, str]] = {
    "a bone through zero length": (
        _shrinking_forearm,
        "Below 1 mm its swing fades to none: at most 20 times step / 1 mm.",
    ),
    "an arm through straight": (
        _bending_arm,
        "At most 8 times the bend's step.",
    ),
    "a forearm past its fold, two degrees beside": (
        partial(_bending_arm, around=math.pi, across=0.035),
        "The roll goes round with the way to the antipode: at most 8 times step / 2 degrees.",
    ),
    "a forearm through its fold": (
        partial(_bending_arm, around=math.pi),
        "The roll jumps 0.8 degrees before the fold and after it, the bone's direction does "
        "not: frames on a sphere cannot be combed without a whirl.",
    ),
    "shoulders through the spine's direction": (
        partial(_shoulders_through_the_spine, direction=(0.6, 0, 0.8)),
        "Below 1 mm the hips' line takes over: at most 20 times step / 1 mm.",
    ),
    "shoulders through the spine's direction, against the hips": (
        partial(_shoulders_through_the_spine, direction=(1, 0, 0)),
        "They pass the exact opposite of their stand-in: either way round is as good.",
    ),
    "left and right changing places": (
        _left_and_right_change_places,
        "Both lines vanish at once; the world's x axis takes over below 1 mm.",
    ),
    "hips through the shoulders": (
        _hips_through_the_shoulders,
        "The spine vanishes; the world's y axis takes over below 1 mm.",
    ),
    "a nose through the ears' line": (_nose_through_the_ears, _EYES),
    "ears through each other": (_ears_through_each_other, _EYES),
    "shoulders round to the back of the hips": (
        _shoulders_round_the_hips,
        "The trunk's box follows the middle of two directions, and jumps where they are "
        "opposite: it could be either side.",
    ),
}
"""By name: parameters ``s [T]`` in [-1, 1] → poses ``[T, 33, 3]``, singular at s = 0; and the bound
on how fast a frame turns there, or the reason why it jumps."""
