"""Bone frames and 6D pose code from joint positions alone.

A bone's direction is seen, its twist is not. The trunk and the head have two baselines each and
get whole frames (hubs); a limb's frame is its parent's, swung by the shortest way to where the
bone points. Swing-only frames never flip with landmark noise, which a look-at frame (singular
when the arm points along the reference) and a bend-plane frame (undefined for a straight limb) do.
Only products, square roots and selections are used: no inverse trigonometry, so that values and
gradients stay finite on straight, folded and vanishing bones.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from gsgan.skeleton.rotation6d import orthogonal_to, rotation_from_6d, rotation_to_6d
from gsgan.skeleton.template import CHEST, HEAD, MEDIAPIPE33, N_HUBS, PELVIS, SkeletonTemplate
from gsgan.utils.constants import constant

Twist = Literal["none", "hinge"]

MIN_LENGTH = 1e-3
"""Metres: a shorter bone or baseline gives no direction (1 mm, below any landmark's accuracy)."""
FOLDED = 1e-4
"""A swing with ``1 + cos(angle)`` below this is composed by way of the opposite direction."""


@dataclass(frozen=True)
class BoneFrames:
    """The frames of one batch of skeletons.

    Convention: rotations take the frame's axes to the world; at the rest directions every limb
    frame equals its hub's.

    Args:
        hubs: ``[B, 3, 3, 3]`` pelvis, chest, head; columns are left, up, front.
        limbs: ``[B, L, 3, 3]`` limb frames.
        local: ``[B, L, 3, 3]`` the same relative to the parent's frame.
        lengths: ``[B, L]`` metres, ``sqrt(|bone|² + min_length²)``.
        torso: ``[B, 3, 3]`` the frame of the trunk's box.
    """

    hubs: Tensor
    limbs: Tensor
    local: Tensor
    lengths: Tensor
    torso: Tensor


class Swing(NamedTuple):
    """The shortest rotations from fixed unit directions ``rest [M, 3]`` to any other."""

    rest: Tensor
    straight: Tensor
    folded: Tensor

    @classmethod
    def of(cls, rest: Tensor) -> Swing:
        half_turn_rest = _half_turn(rest)
        return cls(rest, half_turn_rest, half_turn_rest @ _half_turn(orthogonal_to(rest)))

    def to(self, d: Tensor, folded: float = FOLDED) -> Tensor:
        """``[B, M, 3, 3]`` rotations taking ``rest`` to the directions ``d [B, M, 3]``.

        A d shorter than 1 takes it part of the way, a zero d nowhere.

        Two half turns, about ``rest`` and then about the bisector of ``rest`` and ``d``, make the
        swing; it needs no division by ``1 + cos``. Where ``1 + cos < folded`` the bisector is lost
        and a third half turn, about a fixed axis across ``rest``, goes first: the result still
        takes ``rest`` exactly to ``d``, with a roll that is arbitrary but fixed.
        """
        cos = (self.rest * d).sum(-1, keepdim=True)
        is_folded = cos + 1.0 < folded
        w = d + torch.where(is_folded, -self.rest, self.rest)
        first = torch.where(is_folded.unsqueeze(-1), self.folded, self.straight)
        return _half_turn(w) @ first


def _half_turn(axis: Tensor) -> Tensor:
    """``[..., 3, 3]``: ``2 a aᵀ / |a|² - I``, by half a turn about ``axis [..., 3]``."""
    scaled = axis * (2.0 / axis.square().sum(-1, keepdim=True))
    eye = torch.eye(3, dtype=axis.dtype, device=axis.device)
    return scaled.unsqueeze(-1) * axis.unsqueeze(-2) - eye


class _Level(NamedTuple):
    """Limbs whose parents' frames are known together."""

    limbs: Tensor  # [M] into the template's limbs
    parents: Tensor  # [M] into the frames known so far: hubs, then limbs in order of level
    swing: Swing
    hinge: tuple[Tensor, Tensor] | None  # (upper, lower) limbs [M]; a limb without one has itself
    across: Tensor  # [2, M, 3] hinge axis h, and rest x h
    about: tuple[Tensor, Tensor]  # [M, 3, 3] cross-product matrix of rest, and rest restᵀ


class Constants(NamedTuple):
    """What the functions of this folder need of a template, as tensors."""

    rest: Tensor  # [J, 3]
    starts: Tensor  # [L]
    ends: Tensor  # [L]
    levels: tuple[_Level, ...]
    limb_order: Tensor  # [L] undoes the sorting by level
    head_from_eyes: Tensor  # [3, 3]
    head_points: Tensor  # [5] left ear, right ear, left eye, right eye, nose
    torso: Tensor  # [4]
    face_turned: Tensor  # [F] face joints but the nose
    face_swing: Swing
    omega_order: Tensor  # [J] into pelvis, chest, head, face, limbs
    axes: Tensor  # [3, 3] world axes


@lru_cache(maxsize=64)
def constants(template: SkeletonTemplate, device: torch.device, dtype: torch.dtype) -> Constants:
    """The template's tensors on a device, made once."""
    # tensors born in inference mode could not be used for training later
    with torch.inference_mode(False), torch.no_grad():
        return _constants(template, device, dtype)


def _constants(t: SkeletonTemplate, device: torch.device, dtype: torch.dtype) -> Constants:
    def number(values: object) -> Tensor:
        # normalised in float64 first: constants are right to the last bit of their dtype
        return torch.tensor(values, dtype=torch.float64)

    def index(values: object) -> Tensor:
        return torch.tensor(values, dtype=torch.int64, device=device)

    def cast(value: Tensor) -> Tensor:
        return value.to(device=device, dtype=dtype)

    def swing(rest: Tensor) -> Swing:
        return Swing(*(cast(part) for part in Swing.of(rest)))

    rest = number(t.rest_positions)
    directions = number(t.rest_directions)
    sorted_limbs = [limb for level in t.levels for limb in level]
    known = {hub: hub for hub in range(N_HUBS)}
    known |= {N_HUBS + limb: N_HUBS + k for k, limb in enumerate(sorted_limbs)}
    hinge_of = {limb: pair for pair in t.hinges for limb in pair}
    axis_of = {limb: a for pair, a in zip(t.hinges, t.hinge_axes, strict=True) for limb in pair}

    levels = []
    for limbs in t.levels:
        a = directions[list(limbs)]
        h = number([axis_of.get(limb, (0.0, 0.0, 0.0)) for limb in limbs])
        pairs = [hinge_of.get(limb, (limb, limb)) for limb in limbs]
        has_hinge = any(limb in hinge_of for limb in limbs)
        levels.append(
            _Level(
                limbs=index(limbs),
                parents=index([known[t.limb_parents[limb]] for limb in limbs]),
                swing=swing(a),
                hinge=(index([p[0] for p in pairs]), index([p[1] for p in pairs]))
                if has_hinge
                else None,
                across=cast(torch.stack([h, torch.linalg.cross(a, h)])),
                about=(cast(_cross_matrix(a)), cast(a.unsqueeze(-1) * a.unsqueeze(-2))),
            )
        )

    left, right = t.eyes
    eye_frame = _two_axes(rest[left] - rest[right], rest[t.nose] - (rest[left] + rest[right]) / 2)
    turned = [j for j in t.face if j != t.nose]
    from_ears = rest[turned] - rest[list(t.ears)].mean(0)
    n_turned, incoming = len(turned), t.incoming
    place = dict.fromkeys(t.hips, PELVIS) | dict.fromkeys(t.shoulders, CHEST) | {t.nose: HEAD}
    place |= {joint: N_HUBS + k for k, joint in enumerate(turned)}
    place |= {joint: N_HUBS + n_turned + limb for joint, limb in incoming.items()}
    return Constants(
        rest=cast(rest),
        starts=index([a for a, _ in t.limbs]),
        ends=index([b for _, b in t.limbs]),
        levels=tuple(levels),
        limb_order=index([sorted_limbs.index(limb) for limb in range(len(t.limbs))]),
        head_from_eyes=cast(_head_columns(*eye_frame).mT.contiguous()),
        head_points=index([*t.ears, *t.eyes, t.nose]),
        torso=index(t.torso),
        face_turned=index(turned),
        face_swing=swing(from_ears / from_ears.norm(dim=-1, keepdim=True)),
        omega_order=index([place[joint] for joint in range(len(t.names))]),
        axes=cast(torch.eye(3, dtype=torch.float64)),
    )


def _cross_matrix(v: Tensor) -> Tensor:
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).unflatten(-1, (3, 3))


def _two_axes(first: Tensor, second: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Unit first axis, unit part of the second across it, and their cross product (2 x 1)."""
    e1 = _unit(first)
    e2 = _unit(_across(e1, second))
    return e1, e2, torch.linalg.cross(e2, e1)


def _head_columns(left: Tensor, front: Tensor, up: Tensor) -> Tensor:
    return torch.stack([left, up, front], dim=-1)


def _unit(v: Tensor) -> Tensor:
    return v * v.square().sum(-1, keepdim=True).rsqrt()


def check_skeleton(
    owner: str, p: Tensor, valid: Tensor | None, template: SkeletonTemplate
) -> Tensor:
    """The validity mask, all true when None.

    Raises:
        ValueError: naming the argument, when a shape does not fit the template.
    """
    joints = len(template.names)
    if p.ndim != 3 or p.shape[1:] != (joints, 3) or not p.is_floating_point():
        raise ValueError(
            f"{owner}: p must be a float tensor of shape [B, {joints}, 3], "
            f"got {p.dtype} {list(p.shape)}"
        )
    if valid is None:
        return torch.ones(p.shape[:2], dtype=torch.bool, device=p.device)
    if valid.shape != p.shape[:2] or valid.dtype != torch.bool:
        raise ValueError(
            f"{owner}: valid must be a bool tensor of shape {list(p.shape[:2])}, "
            f"got {valid.dtype} {list(valid.shape)}"
        )
    return valid


def root_of(p: Tensor, template: SkeletonTemplate = MEDIAPIPE33) -> Tensor:
    """``[B, 3]`` metres: the middle of the hips of joints ``[B, J, 3]``."""
    left, right = template.hips
    return (p[:, left] + p[:, right]) / 2


def bone_frames(
    p: Tensor,
    valid: Tensor | None = None,
    template: SkeletonTemplate = MEDIAPIPE33,
    *,
    twist: Twist = "none",
    min_length: float = MIN_LENGTH,
    folded: float = FOLDED,
) -> BoneFrames:
    """The frames of trunk, head and limbs.

    Convention: metres, world frame; everything but the last-resort fallbacks turns with the
    skeleton. The head needs nose and ears, else nose and eyes, else it takes the chest's frame.
    Shoulders and hips in line with the spine borrow each other's baseline, then a world axis.
    Below ``min_length`` a bone's swing fades to none and a baseline to its stand-in, so that what
    vanishes and grows again does not jump: a joint's step moves a frame by at most a few times
    ``step / min_length``. Four places must jump, for no continuous choice exists: a limb folded
    right back, shoulders turned right back over the hips, a baseline that passes its stand-in's
    exact opposite below ``min_length``, and the world axis that a trunk without width falls back
    to.

    Args:
        p: ``[B, J, 3]`` finite joints (see :func:`gsgan.skeleton.sanitise`).
        valid: ``[B, J]`` bool, False where a joint is a stand-in; None: all seen.
        template: names the joints.
        twist: ``hinge`` turns arms and legs about their bones towards the bend plane, by a weight
            that grows from 0 when straight as sin²(bend); ``none`` leaves the swing alone.
        min_length: metres, below which a bone has no full direction.
        folded: ``1 + cos`` below which two directions count as opposite: a swing as folded back,
            shoulders as turned back over the hips.

    Returns:
        BoneFrames.

    Raises:
        ValueError: on a shape that does not fit the template, or an unknown ``twist``.

    Source: method notes, section 6 (6D bone rotations of paper Sec. 3.5, which leaves the frames
    open).
    """
    if twist not in ("none", "hinge"):
        raise ValueError(f"bone_frames: twist must be 'none' or 'hinge', got {twist!r}")
    valid = check_skeleton("bone_frames", p, valid, template)
    c = constants(template, p.device, p.dtype)
    # baselines are differences of nearby points: exact once the root is taken off
    q = p - p[:, template.hips[0], None].detach()
    trunk = _trunk(q, c, min_length, folded)
    hubs = torch.cat([trunk[:, :2], _head(q, valid, trunk[:, 1], c, min_length)], dim=1)

    bones = q.index_select(1, c.ends) - q.index_select(1, c.starts)
    length2 = bones.square().sum(-1, keepdim=True)
    directions, _ = _shortened(bones, min_length)
    lengths = (length2.squeeze(-1) + min_length**2).sqrt()

    known, relative = hubs, []
    for level in c.levels:
        parent = known.index_select(1, level.parents)
        d = (directions.index_select(1, level.limbs).unsqueeze(-2) @ parent).squeeze(-2)
        local = level.swing.to(d, folded)
        if twist == "hinge" and level.hinge is not None:
            upper, lower = (directions.index_select(1, limbs) for limbs in level.hinge)
            local = local @ _towards_hinge(parent @ local, upper, lower, level)
        relative.append(local)
        known = torch.cat([known, parent @ local], dim=1)
    return BoneFrames(
        hubs=hubs,
        limbs=known[:, N_HUBS:].index_select(1, c.limb_order),
        local=torch.cat(relative, dim=1).index_select(1, c.limb_order),
        lengths=lengths,
        torso=trunk[:, 2],
    )


def _trunk(q: Tensor, c: Constants, min_length: float, folded: float) -> Tensor:
    """``[B, 3, 3, 3]`` frames of pelvis, chest and the box between them.

    They share the up axis, the long baseline from hips to shoulders; left comes from the hips, the
    shoulders, or both.
    """
    l_sh, r_sh, l_hip, r_hip = q.index_select(1, c.torso).unbind(1)
    spine = (l_sh + r_sh - l_hip - r_hip) * 0.5
    up = _faded(spine, c.axes[1], min_length, folded).unsqueeze(1)

    lines = torch.stack([l_hip - r_hip, l_sh - r_sh], dim=1)
    lines = _across(up, lines)
    least = c.axes[up.detach().abs().argmin(-1).squeeze(1)].unsqueeze(1)
    # the world's x axis unless the spine lies along it
    stray = _unit(_across(up, torch.where(up[..., :1].abs() < 0.9, c.axes[0], least)))
    other = _faded(lines.flip(1), stray, min_length, folded)
    lines = _faded(lines, other, min_length, folded)
    # once more: a line nearly along the spine has kept the rounding of its long part
    lines = _unit(_across(up, lines))
    both = lines.sum(1, keepdim=True)
    opposed = both.square().sum(-1, keepdim=True) < 2 * folded  # turned back to front
    left = torch.cat([lines, _unit(torch.where(opposed, lines[:, :1], both))], dim=1)
    up = up.expand_as(left)
    return torch.stack([left, up, torch.linalg.cross(left, up)], dim=-1)


def _head(q: Tensor, valid: Tensor, chest: Tensor, c: Constants, min_length: float) -> Tensor:
    """``[B, 1, 3, 3]`` from ears and nose, else eyes and nose, else the chest's frame.

    A baseline that shrinks below ``min_length`` hands over to the next frame little by little.
    """
    points = q.index_select(1, c.head_points)
    seen = valid.index_select(1, c.head_points)
    pairs, nose = points[:, :4].unflatten(1, (2, 2)), points[:, 4:]
    seen_pair = seen[:, :4].unflatten(1, (2, 2)).all(-1) & seen[:, 4:]

    left, wide = _shortened(pairs[:, :, 0] - pairs[:, :, 1], min_length)
    front = nose - (pairs[:, :, 0] + pairs[:, :, 1]) * 0.5
    front, deep = _shortened(_across(left, front), min_length)
    frames = torch.stack([left, torch.linalg.cross(front, left), front], dim=-1)
    share = torch.where(seen_pair.unsqueeze(-1), wide * deep, 0.0).unsqueeze(-1)

    (by_ears, by_eyes), (ears, eyes) = share.unbind(1), frames.unbind(1)
    head = by_eyes * (eyes @ c.head_from_eyes) + (1 - by_eyes) * chest
    head = rotation_from_6d(rotation_to_6d(by_ears * ears + (1 - by_ears) * head))
    return head.unsqueeze(1)


def _faded(v: Tensor, fallback: Tensor, min_length: float, folded: float) -> Tensor:
    """Unit v; below ``min_length`` it leans towards the unit ``fallback``, which it is at 0.

    No map from the ball to the sphere is the identity on the surface and continuous throughout, so
    one place must jump: here the single v, opposite to the fallback, where the two cancel.
    """
    v = v / min_length
    v = v + (1 - v.square().sum(-1, keepdim=True)).clamp_min(0) * fallback
    lost = v.square().sum(-1, keepdim=True) < folded
    return _unit(torch.where(lost, fallback, v))


def _shortened(v: Tensor, min_length: float) -> tuple[Tensor, Tensor]:
    """v by the larger of its length and ``min_length``, and its squared length then."""
    length2 = v.square().sum(-1, keepdim=True)
    return (
        v * length2.clamp_min(min_length**2).rsqrt(),
        (length2 / min_length**2).clamp_max(1),
    )


def _across(axis: Tensor, v: Tensor) -> Tensor:
    """The part of v across a unit ``axis``."""
    return v - axis * (axis * v).sum(-1, keepdim=True)


def _towards_hinge(R: Tensor, upper: Tensor, lower: Tensor, level: _Level) -> Tensor:
    """``[B, M, 3, 3]`` turns about the bone, in the limb's own frame, towards the bend plane.

    The plane's normal is ``n = upper x lower``, ``|n| = sin(bend)``. The turn by the angle from
    the hinge axis to n is mixed with no turn as unit complex numbers, weighted by ``|n|²``: no
    angle is formed, and a straight limb, where n is noise, is left alone.
    """
    normal = torch.linalg.cross(upper, lower)
    weight = normal.square().sum(-1, keepdim=True)
    # |n| with a floor far below one in a million, so that its slope at 0 is finite
    sine = (weight + 1e-12).sqrt()
    in_frame = normal.unsqueeze(-2) @ R
    parts = (in_frame * level.across.transpose(0, 1)).sum(-1) * sine
    turn = torch.stack([1.0 - weight.squeeze(-1) + parts[..., 0], parts[..., 1]], dim=-1)
    norm2 = turn.square().sum(-1, keepdim=True)
    lost = norm2 < FOLDED  # half a turn at half weight: either way is as good
    turn = torch.where(lost, constant((1.0, 0.0), turn), turn)
    cos, sin = _unit(turn)[..., None, None].unbind(-3)
    cross, along = level.about
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    return cos * (eye - along) + along + sin * cross


def omega(
    p: Tensor,
    valid: Tensor | None,
    R_cam: Tensor | None,
    template: SkeletonTemplate = MEDIAPIPE33,
    frame: Literal["camera", "world"] = "camera",
    *,
    frames: BoneFrames | None = None,
    min_length: float = MIN_LENGTH,
) -> Tensor:
    """The 6D pose code Ω, incoming-bone convention.

    Convention: joint j carries the rotation of the bone that ends at j relative to its parent's
    frame. Hips carry the pelvis and shoulders the chest, in camera axes, so that the code knows
    the viewpoint; the nose carries the head relative to the chest, the other face joints the swing
    of their line from the middle of the ears. All but hips and shoulders are unmoved by a rigid
    motion.

    Args:
        p: ``[B, J, 3]`` finite joints, metres, world frame.
        valid: ``[B, J]`` bool or None.
        R_cam: ``[B, 3, 3]`` world to camera; unused (None allowed) when ``frame`` is world.
        template: names the joints.
        frame: axes the hubs are given in.
        frames: of the same skeletons, when they are at hand already.
        min_length: metres, below which the swing of a face joint fades.

    Returns:
        ``[B, J, 6]``, see :func:`rotation_to_6d`.

    Raises:
        ValueError: on a wrong shape, an unknown ``frame``, or a missing ``R_cam``.

    Source: method notes, section 6; pose code of paper Sec. 3.5 (DANBO's input).
    """
    valid = check_skeleton("omega", p, valid, template)
    if frame not in ("camera", "world"):
        raise ValueError(f"omega: frame must be 'camera' or 'world', got {frame!r}")
    f = frames or bone_frames(p, valid, template, min_length=min_length)
    c = constants(template, p.device, p.dtype)
    pelvis_chest, chest, head = f.hubs[:, :HEAD], f.hubs[:, CHEST], f.hubs[:, HEAD]
    if frame == "camera":
        if R_cam is None or R_cam.shape != (len(p), 3, 3):
            got = None if R_cam is None else list(R_cam.shape)
            raise ValueError(f"omega: R_cam must have shape [{len(p)}, 3, 3], got {got}")
        pelvis_chest = R_cam.unsqueeze(1) @ pelvis_chest
    ears = p.index_select(1, c.head_points[:2])
    d = (p.index_select(1, c.face_turned) - ears[:, :1]) - (ears[:, 1:] - ears[:, :1]) * 0.5
    d = d * d.square().sum(-1, keepdim=True).clamp_min(min_length**2).rsqrt()
    face = c.face_swing.to(d @ head)
    rotations = torch.cat([pelvis_chest, (chest.mT @ head).unsqueeze(1), face, f.local], dim=1)
    return rotation_to_6d(rotations.index_select(1, c.omega_order))
