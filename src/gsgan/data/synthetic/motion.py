"""The poses of the synthetic person: inverse kinematics from the choreography to joint rotations.

Convention: metres, Z up. "Mirrored" vectors have x pointing away from the middle of the body on
both sides.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gsgan.body.free import Body, free_body
from gsgan.body.lbs import axis_angle_to_matrix, forward_kinematics
from gsgan.data.synthetic.choreography import (
    Controls,
    controls_at,
    frame_times,
    passage_names,
    smoothstep,
)

SIDES = ("L", "R")
SPINE = ("spine05", "spine03", "spine02", "spine01")
NECK = ("neck01", "neck02", "head")


def motion(frames: int, seed: int = 0) -> tuple[Tensor, Tensor, list[str]]:
    """The choreography as poses of the free body.

    Args:
        frames: number of moments; more frames sample the same choreography more finely.
        seed: of amplitudes, phases and leading hands.

    Returns:
        ``theta [F, 56, 3]`` axis-angle, ``transl [F, 3]`` metres, and the passage of each frame.
    """
    c = controls_at(frame_times(frames), seed)
    solver = _Solver(free_body().to(torch.float64), c.pelvis)
    solver.turn("root", c.root)
    for name in SPINE:
        solver.turn(name, c.spine / len(SPINE))
    for name in NECK:
        solver.turn(name, c.head / len(NECK))
    for i, side in enumerate(SIDES):
        _leg(solver, c, i, side)
        _arm(solver, c, i, side)
        _hand(solver, c, i, side)
    return solver.theta.float(), c.pelvis.float(), passage_names(frames)


class _Solver:
    """Joint rotations under construction, with forward kinematics of the joints set so far."""

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
        """Turns a two-bone limb so that it reaches a target, its middle joint towards the pole.

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
        target: ``[F, 3]`` metres from the first joint.
        pole: ``[F, 3]`` direction in which the middle joint bends.
        upper, lower: lengths of the bones, metres.
        reach: bound of the target's distance in full lengths; below 1, so that it bends.
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
    # feet follow the body's heading, not its lean
    heading = torch.atan2(R_root[:, 1, 0], R_root[:, 0, 0])
    zero = torch.zeros_like(heading)
    flat = axis_angle_to_matrix(torch.stack([zero, zero, heading], -1))
    tilt = axis_angle_to_matrix(torch.stack([c.pitch[:, i], zero, zero], -1))
    solver.turn(f"foot.{side}", matrix_to_axis_angle(R_shank.mT @ flat @ tilt))


def _arm(solver: _Solver, c: Controls, i: int, side: str) -> None:
    lift = 0.5 * smoothstep((c.wrist[:, i, 2] + 0.15) / 0.6)
    sign = 1 if side == "L" else -1  # a mirrored axis-angle has the opposite y and z
    raised = torch.stack([0 * lift, -lift / 2 * sign, 0 * lift * sign], -1)
    solver.turn(f"clavicle.{side}", raised)
    solver.turn(f"shoulder01.{side}", raised)
    R_chest, _ = solver.world("spine01")
    _, shoulder = solver.world(f"upperarm01.{side}")
    target = shoulder + (R_chest @ _mirror(c.wrist[:, i], side)[..., None]).squeeze(-1)
    pole = (R_chest @ _mirror(c.elbow[:, i], side)[..., None]).squeeze(-1)
    names = (f"upperarm01.{side}", f"upperarm02.{side}", f"lowerarm01.{side}", f"wrist.{side}")
    solver.limb(names, target, pole)


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
    """Unit vector out of the palm of 21 hand landmarks, to the side the resting fingers bend."""
    normal = _unit(torch.linalg.cross(hand[5] - hand[0], hand[17] - hand[0]))
    bases = [5, 9, 13, 17]
    bend = sum(_unit(hand[b + 3] - hand[b + 2]) - _unit(hand[b + 1] - hand[b]) for b in bases)
    return normal * torch.sign((torch.as_tensor(bend) * normal).sum())
