"""The choreography of the synthetic person: a smooth function of time, and which of it is held out.

Convention: metres, Z up, the person faces -Y at the start and stands on z = 0. Passages describe
where pelvis, wrists and ankles go; two-bone inverse kinematics turns that into joint rotations of
the free body. "Mirrored" vectors have x pointing away from the middle of the body on both sides.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from gsgan.body.free import Body, free_body
from gsgan.body.lbs import axis_angle_to_matrix, forward_kinematics

SIDES = ("L", "R")
SPINE = ("spine05", "spine03", "spine02", "spine01")
NECK = ("neck01", "neck02", "head")

# Largest rotation of a joint against its parent, radians: what a person can do, with the fingers'
# middle and last joints in one. First match counts.
JOINT_LIMITS = (
    (r"root", math.pi),
    (r"spine\d\d", 0.45),
    (r"neck\d\d|head", 0.45),
    (r"clavicle|shoulder01", 0.45),
    (r"upperarm01", 2.6),
    (r"upperarm02", 1.2),
    (r"lowerarm01", 2.6),
    (r"lowerarm02|wrist", 1.2),
    (r"finger\d-\d", 1.9),
    (r"upperleg01", 2.2),
    (r"upperleg02", 0.9),
    (r"lowerleg01", 2.6),
    (r"foot", 1.0),
    (r".*", 0.5),
)


def joint_limit(name: str) -> float:
    """Largest rotation angle, radians, of a joint of the free body."""
    stem = name.split(".")[0]
    return next(limit for pattern, limit in JOINT_LIMITS if re.fullmatch(pattern, stem))


@dataclass(frozen=True)
class Controls:
    """What the body is asked to do, F moments; sides are left, right.

    Args:
        pelvis: ``[F, 3]`` metres from where the rest pose has it.
        root: ``[F, 3]`` axis-angle of the whole body.
        spine: ``[F, 3]`` axis-angle, shared out over the spine.
        head: ``[F, 3]`` axis-angle, shared out over neck and head.
        wrist: ``[F, 2, 3]`` metres from the shoulder, chest axes, mirrored.
        elbow: ``[F, 2, 3]`` where the elbow points, chest axes, mirrored.
        palm: ``[F, 2]`` forearm twist, radians, positive turns the palm up.
        flex: ``[F, 2]`` wrist flexion towards the palm, radians.
        curl: ``[F, 2, 5]`` finger flexion in [0, 1], thumb first.
        ankle: ``[F, 2, 3]`` metres: mirrored x and y in the world, z above the standing height.
        pitch: ``[F, 2]`` radians, positive lifts the heel.
    """

    pelvis: Tensor
    root: Tensor
    spine: Tensor
    head: Tensor
    wrist: Tensor
    elbow: Tensor
    palm: Tensor
    flex: Tensor
    curl: Tensor
    ankle: Tensor
    pitch: Tensor


def neutral(frames: int) -> Controls:
    """Standing at ease, arms hanging."""

    def still(*values: float, shape: tuple[int, ...]) -> Tensor:
        return torch.tensor(values, dtype=torch.float64).expand(frames, *shape).clone()

    return Controls(
        pelvis=still(0, 0, -0.015, shape=(3,)),
        root=still(0, shape=(3,)),
        spine=still(0, shape=(3,)),
        head=still(0, shape=(3,)),
        wrist=still(0.13, -0.04, -0.5, shape=(2, 3)),
        elbow=still(0.5, 1.0, -0.2, shape=(2, 3)),
        palm=still(0, shape=(2,)),
        flex=still(0, shape=(2,)),
        curl=still(0.25, shape=(2, 5)),
        ankle=still(0.125, 0, 0, shape=(2, 3)),
        pitch=still(0, shape=(2,)),
    )


# ---------------------------------------------------------------- passages
# Each writes into neutral controls, given time in [0, 1] through the passage and a style.


@dataclass(frozen=True)
class Style:
    """What the seed changes: amplitude, phase (radians), and which hand leads (0 left, 1 right)."""

    amplitude: float
    phase: float
    lead: int


Passage = Callable[[Controls, Tensor, Style], None]
TAU = 2 * math.pi


def walk(c: Controls, s: Tensor, style: Style) -> None:
    """Walking on the spot, the trunk turning slowly left and right."""
    _step(c, TAU * 2 * s + style.phase, style.amplitude)
    c.root[:, 2] += 0.7 * torch.sin(TAU * s)


def _step(c: Controls, phase: Tensor, amplitude: float) -> None:
    for i, shift in enumerate((0.0, math.pi)):
        a = phase + shift
        lift = torch.sin(a).clamp_min(0) ** 2
        c.ankle[:, i, 1] += 0.24 * amplitude * torch.cos(a)
        c.ankle[:, i, 2] += 0.16 * amplitude * lift
        c.pitch[:, i] += 0.45 * lift * torch.cos(a)
        c.ankle[:, i, 0] += -0.02
        c.wrist[:, i, 1] += -0.10 - 0.24 * amplitude * torch.cos(a + math.pi)
        c.wrist[:, i, 2] += 0.03 + 0.05 * torch.cos(a) ** 2
    c.pelvis[:, 2] += -0.035 + 0.015 * torch.cos(2 * phase)
    c.spine[:, 2] += 0.14 * amplitude * torch.cos(phase)


def arm_swings(c: Controls, s: Tensor, style: Style) -> None:
    """Straight arms swung forwards, sideways and back, out of step."""
    for i, shift in enumerate((0.0, 0.35)):
        swing = 0.5 - 0.5 * torch.cos(TAU * (s - 0.2 * shift))
        around = TAU * 1.5 * s + style.phase + shift * TAU
        angle = 1.55 * style.amplitude * swing
        out = 0.5 + 0.5 * torch.sin(around)
        reach = 0.55
        c.wrist[:, i, 0] = 0.10 + reach * torch.sin(angle) * out
        c.wrist[:, i, 1] = -0.04 - reach * torch.sin(angle) * (1 - out)
        c.wrist[:, i, 2] = -reach * torch.cos(angle)
    c.spine[:, 0] += -0.12 * torch.sin(TAU * s)


def wave(c: Controls, s: Tensor, style: Style) -> None:
    """One hand waves beside the head, the other rests on the hip."""
    _wave_arm(c, style.lead, TAU * 3 * s + style.phase, style.amplitude)
    other = 1 - style.lead
    c.wrist[:, other] = c.wrist.new_tensor([0.05, -0.08, -0.38])
    c.elbow[:, other] = c.elbow.new_tensor([1.0, 0.6, 0.0])
    c.curl[:, other] += 0.35
    c.head[:, 2] += (0.3 if style.lead == 0 else -0.3) * torch.sin(math.pi * s)


def _wave_arm(c: Controls, side: int, phase: Tensor, amplitude: float) -> None:
    c.wrist[:, side, 0] = 0.24 + 0.12 * amplitude * torch.sin(phase)
    c.wrist[:, side, 1] = -0.16
    c.wrist[:, side, 2] = 0.26
    c.elbow[:, side] = c.elbow.new_tensor([1.0, 0.4, -0.9])
    c.palm[:, side] = 0.5
    c.curl[:, side] = 0.05


def squat(c: Controls, s: Tensor, style: Style) -> None:
    """Two squats, arms reaching forwards for balance."""
    _squat_legs(c, 0.5 - 0.5 * torch.cos(TAU * 2 * s), style.amplitude)
    depth = 0.5 - 0.5 * torch.cos(TAU * 2 * s)
    for i in range(2):
        c.wrist[:, i, 0] = 0.10 - 0.04 * depth
        c.wrist[:, i, 1] = -0.04 - 0.44 * depth
        c.wrist[:, i, 2] = -0.5 + 0.44 * depth


def _squat_legs(c: Controls, depth: Tensor, amplitude: float) -> None:
    c.pelvis[:, 2] += -0.36 * amplitude * depth
    c.pelvis[:, 1] += 0.16 * amplitude * depth
    c.root[:, 0] += 0.45 * amplitude * depth
    c.spine[:, 0] += 0.15 * depth
    c.head[:, 0] += -0.35 * depth
    c.ankle[:, :, 0] += 0.06


def overhead(c: Controls, s: Tensor, style: Style) -> None:
    """Both arms rise to above the head and circle there."""
    rise = torch.sin(math.pi * s) ** 2
    for i, shift in enumerate((0.0, 1.3)):
        circle = TAU * 2 * s + style.phase + shift
        angle = rise * 2.75 * (0.92 + 0.08 * style.amplitude)
        c.wrist[:, i, 0] = 0.10 + 0.42 * torch.sin(angle) + 0.05 * torch.cos(circle) * rise
        c.wrist[:, i, 1] = -0.06 + 0.08 * torch.sin(circle) * rise
        c.wrist[:, i, 2] = torch.where(angle.cos() > 0, -0.48, -0.36) * torch.cos(angle)
        c.elbow[:, i] = c.elbow.new_tensor([1.0, 0.9, -0.1])
    c.curl[...] = (0.25 - 0.2 * rise)[:, None, None]
    c.head[:, 0] += -0.2 * rise


def twist(c: Controls, s: Tensor, style: Style) -> None:
    """The trunk turns and leans from side to side, bent arms held out."""
    turn = torch.sin(TAU * 1.5 * s + 0.3 * style.phase)
    c.spine[:, 2] += 0.75 * style.amplitude * turn
    c.spine[:, 1] += 0.35 * torch.sin(TAU * s + style.phase)
    c.head[:, 2] += -0.4 * turn
    for i, sign in enumerate((1.0, -1.0)):
        c.wrist[:, i, 0] = 0.22 + 0.06 * sign * turn
        c.wrist[:, i, 1] = -0.30
        c.wrist[:, i, 2] = -0.12 + 0.10 * sign * turn
        c.elbow[:, i] = c.elbow.new_tensor([1.0, 0.5, -0.5])
    c.curl[...] = 0.75


def signing(c: Controls, s: Tensor, style: Style) -> None:
    """Both hands move before the chest as in sign language, every finger on its own clock."""
    _sign_arms(c, s, style)
    c.head[:, 2] += 0.2 * torch.sin(TAU * 1.5 * s)
    c.head[:, 0] += 0.12 * torch.sin(TAU * 2.5 * s + 1)


def _sign_arms(c: Controls, s: Tensor, style: Style) -> None:
    for i, shift in enumerate((0.0, 2.1)):
        a = TAU * s + style.phase + shift
        c.wrist[:, i, 0] = -0.02 + 0.11 * torch.sin(2 * a)
        c.wrist[:, i, 1] = -0.31 - 0.06 * style.amplitude * torch.sin(3 * a + 1)
        c.wrist[:, i, 2] = -0.15 + 0.14 * style.amplitude * torch.sin(3 * a)
        c.elbow[:, i] = c.elbow.new_tensor([0.8, 0.3, -1.0])
        c.palm[:, i] = 0.5 + 0.7 * torch.sin(2 * a + 0.5)
        c.flex[:, i] = 0.25 * torch.sin(3 * a + 2)
        for finger in range(5):
            c.curl[:, i, finger] = 0.45 + 0.45 * torch.sin((3 + finger % 3) * a + 1.7 * finger)


def squat_and_wave(c: Controls, s: Tensor, style: Style) -> None:
    """The held-out combination: half a squat while one hand waves and the other signs."""
    _sign_arms(c, s, style)
    _squat_legs(c, 0.65 * torch.sin(math.pi * s) ** 2, style.amplitude)
    _wave_arm(c, style.lead, TAU * 2 * s + style.phase, style.amplitude)
    c.spine[:, 2] += 0.4 * torch.sin(TAU * s)


def freestyle(c: Controls, s: Tensor, style: Style) -> None:
    """Arms, trunk, legs and heading wander, each on its own clock: poses that no other passage has.

    A person who trains on named movements alone is painted worst where two of them meet.
    """
    for i, shift in enumerate((0.0, 2.6)):
        a = style.phase + shift
        rise = 1.25 + 1.1 * style.amplitude * _wander(s, 4.0, a)  # 0 hangs, half a turn is up
        around = 0.75 + 0.7 * _wander(s, 5.3, a + 1)  # 0 before the body, a quarter sideways
        reach = 0.42 + 0.09 * _wander(s, 6.1, a + 2)
        c.wrist[:, i, 0] = 0.06 + reach * torch.sin(rise) * torch.sin(around)
        c.wrist[:, i, 1] = -0.04 - reach * torch.sin(rise).clamp_min(0.1) * torch.cos(around)
        c.wrist[:, i, 2] = -reach * torch.cos(rise)
        c.elbow[:, i] = c.elbow.new_tensor([1.0, 0.6, -0.5])
        c.palm[:, i] = 0.3 + 0.6 * _wander(s, 4.7, a + 3)
        c.flex[:, i] = 0.25 * _wander(s, 5.9, a + 4)
        for finger in range(5):
            c.curl[:, i, finger] = 0.45 + 0.4 * _wander(s, 6.5, a + 5 + 0.9 * finger)
        forth = _wander(s, 3.7, a + 2.2)
        c.ankle[:, i, 0] += 0.03 + 0.04 * _wander(s, 3.1, a + 0.7)
        c.ankle[:, i, 1] += 0.14 * forth
        c.ankle[:, i, 2] += 0.10 * forth.clamp_min(0) ** 2
    _squat_legs(c, 0.6 * (0.5 + 0.5 * _wander(s, 3.3, style.phase + 6)) ** 2, style.amplitude)
    c.spine[:, 2] += 0.6 * _wander(s, 3.5, style.phase + 1.5)
    c.spine[:, 1] += 0.3 * _wander(s, 4.3, style.phase + 2.5)
    c.spine[:, 0] += 0.2 * _wander(s, 3.9, style.phase + 3.5)
    c.head[:, 2] += -0.3 * _wander(s, 4.9, style.phase + 4.5)
    c.head[:, 0] += 0.15 * _wander(s, 5.7, style.phase + 5.5)
    c.root[:, 2] += 0.9 * _wander(s, 2.3, style.phase + 0.5)


def _wander(s: Tensor, cycles: float, phase: float) -> Tensor:
    """Smooth, in [-1, 1], never the same twice within a passage."""
    golden = (1 + math.sqrt(5)) / 2
    slow, fast = TAU * cycles * s + phase, TAU * cycles * golden * s + 2.4 * phase + 1
    return 0.5 * (torch.sin(slow) + torch.sin(fast))


COMBINATION = "squat_and_wave"
# name, what happens, seconds
PASSAGES: tuple[tuple[str, Passage, float], ...] = (
    ("walk", walk, 4.0),
    ("arm_swings", arm_swings, 2.5),
    ("wave", wave, 2.5),
    ("squat", squat, 2.5),
    ("overhead", overhead, 2.5),
    ("twist", twist, 3.0),
    ("signing", signing, 5.0),
    (COMBINATION, squat_and_wave, 3.0),
    ("freestyle", freestyle, 10.0),
)
DURATION = sum(seconds for _, _, seconds in PASSAGES)


def frame_times(frames: int) -> Tensor:
    """``[F]`` seconds: the choreography sampled evenly, in the middle of each step."""
    return (torch.arange(frames, dtype=torch.float64) + 0.5) * DURATION / frames


def passage_names(frames: int) -> list[str]:
    """The passage each frame lies in."""
    return [PASSAGES[int(i)][0] for i in _passage_index(frame_times(frames))]


def _passage_index(times: Tensor) -> Tensor:
    ends = torch.tensor([p[2] for p in PASSAGES], dtype=torch.float64).cumsum(0)
    return torch.searchsorted(ends, times, right=True).clamp_max(len(PASSAGES) - 1)


def controls_at(times: Tensor, seed: int) -> Controls:
    """What the body is asked to do at times ``[F]``: every passage starts and ends standing."""
    index, base = _passage_index(times), neutral(len(times))
    generator = torch.Generator().manual_seed(seed)
    start = 0.0
    for i, (_, passage, seconds) in enumerate(PASSAGES):
        draw = torch.rand(3, generator=generator, dtype=torch.float64)
        style = Style(0.85 + 0.3 * float(draw[0]), TAU * float(draw[1]), int(draw[2] < 0.5))
        here = (index == i).nonzero().squeeze(1)
        s = (times[here] - start) / seconds
        start += seconds
        moved = neutral(len(here))
        passage(moved, s, style)
        share = _ramp(s / 0.15) * _ramp((1 - s) / 0.15)
        for field in fields(Controls):
            rest, goal = getattr(base, field.name), getattr(moved, field.name)
            w = share.view(-1, *[1] * (goal.ndim - 1))
            rest[here] = rest[here] + w * (goal - rest[here])
    return base


def _ramp(x: Tensor) -> Tensor:
    x = x.clamp(0, 1)
    return x * x * (3 - 2 * x)


# ---------------------------------------------------------------- from controls to rotations


def motion(frames: int, seed: int = 0) -> tuple[Tensor, Tensor, list[str]]:
    """The choreography as poses of the free body.

    Args:
        frames: how many moments of the same choreography; more frames sample it more finely.
        seed: changes amplitudes, phases and the leading hand of the passages.

    Returns:
        ``theta [F, 56, 3]`` axis-angle, ``transl [F, 3]`` metres, and the passage of each frame.

    Raises:
        ValueError: when ``frames`` is less than 1.
    """
    if frames < 1:
        raise ValueError(f"motion: frames must be at least 1, got {frames}")
    theta, transl = solve(controls_at(frame_times(frames), seed), free_body())
    return theta.float(), transl.float(), passage_names(frames)


def solve(c: Controls, body: Body) -> tuple[Tensor, Tensor]:
    """Joint rotations ``[F, J, 3]`` and translation ``[F, 3]``, float64, after the controls."""
    body = body.to(torch.float64)
    solver = _Solver(body, c.pelvis)
    solver.turn("root", c.root)
    for name in SPINE:
        solver.turn(name, c.spine / len(SPINE))
    for name in NECK:
        solver.turn(name, c.head / len(NECK))
    for i, side in enumerate(SIDES):
        _leg(solver, c, i, side)
        _arm(solver, c, i, side)
        _hand(solver, c, i, side)
    return solver.theta, c.pelvis


class _Solver:
    """Rotations under construction; asks forward kinematics where a joint is so far."""

    def __init__(self, body: Body, transl: Tensor) -> None:
        self.body, self.transl = body, transl
        self.theta = transl.new_zeros(len(transl), len(body.parents), 3)

    def index(self, name: str) -> int:
        return self.body.joint_names.index(name)

    def rest(self, name: str) -> Tensor:
        return self.body.joints[self.index(name)]

    def turn(self, name: str, axis_angle: Tensor) -> None:
        self.theta[:, self.index(name)] = axis_angle

    def world(self, name: str) -> tuple[Tensor, Tensor]:
        """Rotation ``[F, 3, 3]`` and position ``[F, 3]`` of a joint."""
        rotations = axis_angle_to_matrix(self.theta)
        T = forward_kinematics(self.body.joints, self.body.parents, rotations, self.transl)
        T = T[:, self.index(name)]
        return T[:, :3, :3], T[:, :3, :3] @ self.rest(name) + T[:, :3, 3]

    def limb(self, names: tuple[str, str, str, str], target: Tensor, pole: Tensor) -> Tensor:
        """Points a two-bone limb at a target, its middle joint towards the pole.

        ``names``: first joint, its twist joint, middle joint, end. Returns the world rotation
        ``[F, 3, 3]`` of the lower bone.
        """
        first, roll, middle, end = names
        start, mid, tip = self.rest(first), self.rest(middle), self.rest(end)
        R_parent, origin = self.world(first)
        upper, lower = two_bone(
            target - origin, pole, float((mid - start).norm()), float((tip - mid).norm())
        )
        normal = _unit(torch.linalg.cross(upper, lower))
        rest_normal = _unit(torch.linalg.cross(mid - start, tip - mid))
        R_upper = _frame(upper, normal) @ _frame(mid - start, rest_normal).mT
        R_lower = _frame(lower, normal) @ _frame(tip - mid, rest_normal).mT
        swing, angle = swing_twist(R_parent.mT @ R_upper, mid - start)
        half = 0.5 * angle[:, None] * _unit(mid - start)
        self.turn(first, matrix_to_axis_angle(swing @ axis_angle_to_matrix(half)))
        self.turn(roll, half)
        self.turn(middle, matrix_to_axis_angle(R_upper.mT @ R_lower))
        return R_lower


def two_bone(
    target: Tensor, pole: Tensor, upper: float, lower: float, reach: float = 0.99
) -> tuple[Tensor, Tensor]:
    """Directions of two bones from the origin to a target, by the law of cosines.

    Args:
        target: ``[F, 3]`` metres from the first joint; drawn in to ``reach`` times full length.
        pole: ``[F, 3]`` the side the middle joint bends to.
        upper: length of the first bone, metres.
        lower: length of the second bone, metres.
        reach: largest share of the full length; below 1 so that the bend has a direction.

    Returns:
        The two unit vectors ``[F, 3]``.
    """
    nearest = abs(upper - lower) + 0.05 * min(upper, lower)
    d = target.norm(dim=-1, keepdim=True).clamp(nearest, reach * (upper + lower))
    along = _unit(target)
    side = _unit(pole - (pole * along).sum(-1, keepdim=True) * along)
    cosine = (upper**2 + d**2 - lower**2) / (2 * upper * d)
    middle = upper * (cosine * along + (1 - cosine**2).clamp_min(0).sqrt() * side)
    return _unit(middle), _unit(d * along - middle)


def swing_twist(R: Tensor, axis: Tensor) -> tuple[Tensor, Tensor]:
    """Splits ``R = swing @ twist``, twist about ``axis [3]``: swing ``[F,3,3]``, angle ``[F]``."""
    axis = _unit(axis)
    moved = R @ axis
    normal = torch.linalg.cross(axis.expand_as(moved), moved)
    sine, cosine = normal.norm(dim=-1, keepdim=True), (moved @ axis)[:, None]
    swing = axis_angle_to_matrix(torch.atan2(sine, cosine) * normal / sine.clamp_min(1e-12))
    rest = matrix_to_axis_angle(swing.mT @ R)
    return swing, rest @ axis


def matrix_to_axis_angle(R: Tensor) -> Tensor:
    """Axis-angle ``[..., 3]`` of rotations ``[..., 3, 3]`` by less than π."""
    v = torch.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], -1
    )
    sine = v.norm(dim=-1, keepdim=True) / 2
    cosine = (R.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True) - 1) / 2
    angle = torch.atan2(sine, cosine)
    return v / 2 * torch.where(sine > 1e-9, angle / sine.clamp_min(1e-9), torch.ones_like(sine))


def _unit(v: Tensor) -> Tensor:
    return v / v.norm(dim=-1, keepdim=True).clamp_min(1e-12)


def _frame(along: Tensor, normal: Tensor) -> Tensor:
    """Rotation whose columns are a direction, a normal to it, and their cross product."""
    a = _unit(along)
    return torch.stack([a, normal, torch.linalg.cross(a, normal)], dim=-1)


def _mirror(v: Tensor, side: str) -> Tensor:
    return v * v.new_tensor([1.0 if side == "L" else -1.0, 1.0, 1.0])


def _leg(solver: _Solver, c: Controls, i: int, side: str) -> None:
    ankle = _mirror(c.ankle[:, i], side).clone()
    ankle[:, 2] += solver.rest(f"foot.{side}")[2]
    R_root, _ = solver.world("root")
    forwards = R_root @ _mirror(ankle.new_tensor([0.12, -1.0, 0.0]), side)
    names = (f"upperleg01.{side}", f"upperleg02.{side}", f"lowerleg01.{side}", f"foot.{side}")
    R_shank = solver.limb(names, ankle, forwards)
    # feet keep the body's heading, not its lean
    heading = torch.atan2(R_root[:, 1, 0], R_root[:, 0, 0])
    zero = torch.zeros_like(heading)
    flat = axis_angle_to_matrix(torch.stack([zero, zero, heading], -1))
    tilt = axis_angle_to_matrix(torch.stack([c.pitch[:, i], zero, zero], -1))
    solver.turn(f"foot.{side}", matrix_to_axis_angle(R_shank.mT @ flat @ tilt))


def _arm(solver: _Solver, c: Controls, i: int, side: str) -> None:
    lift = 0.5 * _ramp((c.wrist[:, i, 2] + 0.15) / 0.6)
    raised = _mirror_angle(torch.stack([0 * lift, -lift / 2, 0 * lift], -1), side)
    solver.turn(f"clavicle.{side}", raised)
    solver.turn(f"shoulder01.{side}", raised)
    R_chest, _ = solver.world("spine01")
    _, shoulder = solver.world(f"upperarm01.{side}")
    target = shoulder + (R_chest @ _mirror(c.wrist[:, i], side)[..., None]).squeeze(-1)
    pole = (R_chest @ _mirror(c.elbow[:, i], side)[..., None]).squeeze(-1)
    names = (f"upperarm01.{side}", f"upperarm02.{side}", f"lowerarm01.{side}", f"wrist.{side}")
    solver.limb(names, target, pole)


def _mirror_angle(v: Tensor, side: str) -> Tensor:
    """An axis-angle for the left side, on the given side (the mirror flips y and z)."""
    return v * v.new_tensor([1.0, 1.0, 1.0] if side == "L" else [1.0, -1.0, -1.0])


def _hand(solver: _Solver, c: Controls, i: int, side: str) -> None:
    hand = solver.body.hand_landmarks[21 * i : 21 * (i + 1)]
    palm = palm_direction(hand)
    fore = _unit(hand[0] - solver.rest(f"lowerarm01.{side}"))
    roll = fore if side == "L" else -fore
    solver.turn(f"lowerarm02.{side}", 0.5 * c.palm[:, i, None] * roll)
    bend = _unit(torch.linalg.cross(hand[12] - hand[9], palm))
    solver.turn(f"wrist.{side}", 0.5 * c.palm[:, i, None] * roll + c.flex[:, i, None] * bend)
    for finger in range(5):
        base = 1 + 4 * finger
        hinge = _unit(torch.linalg.cross(hand[base + 1] - hand[base], palm))
        first, second = (0.35, 0.7) if finger == 0 else (1.1, 1.5)
        curl = c.curl[:, i, finger, None]
        solver.turn(f"finger{finger + 1}-1.{side}", first * curl * hinge)
        solver.turn(f"finger{finger + 1}-2.{side}", second * curl * hinge)


def palm_direction(hand: Tensor) -> Tensor:
    """Unit vector out of the palm of 21 hand landmarks: the side the resting fingers bend to."""
    normal = _unit(torch.linalg.cross(hand[5] - hand[0], hand[17] - hand[0]))
    bases = [5, 9, 13, 17]
    bend = sum(_unit(hand[b + 3] - hand[b + 2]) - _unit(hand[b + 1] - hand[b]) for b in bases)
    return normal * torch.sign((torch.as_tensor(bend) * normal).sum())


# ---------------------------------------------------------------- what is held out


def held_out(frames: int, test_frames: int, block: int = 3) -> list[int]:
    """The frames kept for testing: the combination passage first, then blocks inside the others.

    Blocks lie in the middle of passages, so that their neighbours in time are training frames but
    the extreme of the movement is not; the combination is never seen in training.

    Args:
        frames: all frames.
        test_frames: how many to hold out, less than ``frames``.
        block: length of the blocks.

    Raises:
        ValueError: when ``test_frames`` is not in [0, frames), or ``block`` is less than 1.
    """
    if block < 1:
        raise ValueError(f"held_out: block must be at least 1, got {block}")
    if not 0 <= test_frames < frames:
        raise ValueError(
            f"held_out: test_frames must be at least 0 and less than frames = {frames}, "
            f"got {test_frames}"
        )
    names = passage_names(frames)
    chosen = [i for i, name in enumerate(names) if name == COMBINATION][:test_frames]
    others: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        if name != COMBINATION:
            others.setdefault(name, []).append(i)
    order = sorted(others.values(), key=len, reverse=True)
    while len(chosen) < test_frames:
        before = len(chosen)
        for run in order:  # one frame of each passage stays in training as long as possible
            free = [i for i in run if i not in chosen]
            size = max(min(block, test_frames - len(chosen), len(free) - 1), 0)
            begin = (len(free) - size + 1) // 2
            chosen += free[begin : begin + size]
        if len(chosen) == before:
            left = [i for i in range(frames) if i not in chosen]
            chosen += left[: test_frames - len(chosen)]
    return sorted(chosen)
