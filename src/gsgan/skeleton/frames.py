"""Bone frames and 6D pose code from joint positions alone.

Joint positions determine a bone's direction, not its twist. The trunk and the head have two
baselines each and get full frames (hubs); a limb's frame is its parent's, rotated by the shortest
rotation (swing) onto the bone. Swing-only frames never flip with landmark noise, unlike look-at
frames (singular when the arm points along the reference) and bend-plane frames (undefined for a
straight limb). Only products, square roots and selections are used, no inverse trigonometry:
values and gradients stay finite on straight, folded and vanishing bones.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from gsgan.skeleton.face import face_code
from gsgan.skeleton.hands import palm_frames
from gsgan.skeleton.rotation6d import (
    across,
    rotation_from_6d,
    rotation_to_6d,
    unit,
)
from gsgan.skeleton.template import CHEST, HEAD, MEDIAPIPE33, SkeletonTemplate
from gsgan.skeleton.tensors import (
    FOLDED,
    Constants,
    Level,
    check_skeleton,
    constants,
)
from gsgan.utils.tensors import squared_norm

MIN_LENGTH = 1e-3
"""Metres: a shorter bone or baseline has no direction (1 mm, below any landmark's accuracy)."""
# The squares of a rotation's entries sum to 3, those of a palm that shrinks to less.
MIN_SQUARES = 2.99


@dataclass(frozen=True)
class BoneFrames:
    """The frames of a batch of skeletons.

    Rotations map the frame's axes to the world; at the rest directions every limb
    frame equals its hub's.
    """

    # [B, 3 + hands, 3, 3] pelvis, chest, head, with columns left, up, front; and palms
    hubs: Tensor
    limbs: Tensor  # [B, L, 3, 3]
    local: Tensor  # [B, L, 3, 3] the same relative to the parent's frame
    lengths: Tensor  # [B, L] metres, sqrt(|bone|² + MIN_LENGTH²)
    torso: Tensor  # [B, 3, 3] the frame of the trunk's box

    @property
    def head(self) -> Tensor:
        """``[B, 3, 3]``: the frame of the head."""
        return self.hubs[:, HEAD]


def root_of(p: Tensor, template: SkeletonTemplate = MEDIAPIPE33) -> Tensor:
    """``[B, 3]`` metres: the middle of the hips of joints ``[B, J, 3]``."""
    # The middle, since the template has no joint between the hips.
    left, right = template.hips
    return (p[:, left] + p[:, right]) / 2


def bone_frames(
    p: Tensor,
    valid: Tensor | None = None,
    template: SkeletonTemplate = MEDIAPIPE33,
) -> BoneFrames:
    """The frames of trunk, head and limbs.

    Units are metres in the world frame; everything but the last fallbacks rotates with the
    skeleton. The head's frame comes from nose and ears, else from nose and eyes, else from the
    chest. If shoulders or hips are in line with the spine, the other baseline is used, then a world
    axis. Below `MIN_LENGTH` a bone's swing fades to none and a baseline to its fallback, so that
    bones that vanish and grow again do not jump: a joint's step moves a frame by at most a few
    times ``step / MIN_LENGTH``. Four cases must jump, because no continuous choice exists: a limb
    folded back onto itself, shoulders facing backwards over the hips, a baseline that passes the
    exact opposite of its fallback below `MIN_LENGTH`, and the world axis for a trunk without width.

    Args:
        p: ``[B, J, 3]`` finite joints (see :func:`gsgan.skeleton.sanitise`).
        valid: ``[B, J]`` bool, False for joints that were filled in; None: all seen.
        template: names the joints.

    Returns:
        BoneFrames.

    Raises:
        ValueError: when a shape does not match the template.

    Source: ours (6D bone rotations of paper Sec. 3.5, which leaves the frames
    open).
    """
    valid = check_skeleton("bone_frames", p, valid, template)
    c = constants(template, p.device, p.dtype)

    # Baselines are differences of nearby points: exact once the root is subtracted.
    q = p - p[:, template.hips[0], None].detach()
    trunk = _trunk(q, c)
    chest = trunk[:, 1]
    frames = torch.cat([trunk[:, :2], _head(q, valid, chest, c)], dim=1)
    if template.palms:
        frames = torch.cat([frames, palms_of(q, chest.unsqueeze(1), c)], dim=1)

    # Limbs, level by level: each parent's frame is known before.
    bones = q.index_select(1, c.ends) - q.index_select(1, c.starts)
    relative = []
    for level in c.levels:
        parent = frames.index_select(1, level.parents)
        swing = swings(bones.index_select(1, level.limbs), parent, level)
        relative.append(swing)
        frames = torch.cat([frames, parent @ swing], dim=1)

    # The lengths of the bones never reach zero, so that their gradient is finite.
    length2 = squared_norm(bones)
    lengths = (length2.squeeze(-1) + MIN_LENGTH**2).sqrt()
    return BoneFrames(
        hubs=frames[:, : template.n_hubs],
        limbs=frames[:, template.n_hubs :].index_select(1, c.limb_order),
        local=torch.cat(relative, dim=1).index_select(1, c.limb_order),
        lengths=lengths,
        torso=trunk[:, 2],
    )


def swings(bones: Tensor, parent: Tensor, level: Level) -> Tensor:
    """``[B, M, 3, 3]`` frames relative to ``parent [B, M, 3, 3]`` of a level's ``[B, M, 3]``."""
    # Short bones swing only in part.
    directions, _ = _shorten(bones)
    return level.swing.to((directions.unsqueeze(-2) @ parent).squeeze(-2))


def hubs_of(q: Tensor, valid: Tensor, c: Constants) -> Tensor:
    """``[B, 3, 3, 3]`` frames of pelvis, chest and head of joints near the origin."""
    trunk = _trunk(q, c)
    return torch.cat([trunk[:, :2], _head(q, valid, trunk[:, 1], c)], dim=1)


def _trunk(q: Tensor, c: Constants) -> Tensor:
    """``[B, 3, 3, 3]`` frames of pelvis, chest and the box between them.

    They share the up axis, the long baseline from hips to shoulders; the left axis comes from the
    hips, the shoulders, or both.
    """
    # Up is from the middle of the hips to that of the shoulders.
    l_sh, r_sh, l_hip, r_hip = q.index_select(1, c.torso).unbind(1)
    spine = (l_sh + r_sh - l_hip - r_hip) * 0.5
    up = _fade(spine, c.axes[1]).unsqueeze(1)

    # The left axes of hips and shoulders, orthogonal to the spine.
    lines = torch.stack([l_hip - r_hip, l_sh - r_sh], dim=1)
    lines = across(up, lines)

    # A short line fades to the other one, and this to the world's x axis, or, if the spine lies
    # along it, to the axis that is farthest from the spine's direction.
    farthest = c.axes[up.detach().abs().argmin(-1).squeeze(1)].unsqueeze(1)
    axis = torch.where(up[..., :1].abs() < 0.9, c.axes[0], farthest)
    other = _fade(lines.flip(1), unit(across(up, axis)))
    lines = _fade(lines, other)
    # Once more: a line nearly along the spine keeps the rounding of its long part.
    lines = unit(across(up, lines))

    # The box's left axis is their mean, or the hips' if the shoulders face backwards.
    both = lines.sum(1, keepdim=True)
    opposed = squared_norm(both) < 2 * FOLDED
    middle = unit(torch.where(opposed, lines[:, :1], both))
    left = torch.cat([lines, middle], dim=1)
    up = up.expand_as(left)
    return torch.stack([left, up, torch.linalg.cross(left, up)], dim=-1)


def _head(q: Tensor, valid: Tensor, chest: Tensor, c: Constants) -> Tensor:
    """``[B, 1, 3, 3]`` from ears and nose, else eyes and nose, else the chest's frame.

    A baseline that shrinks below `MIN_LENGTH` fades to the next frame.
    """
    # Pairs of ears and of eyes, each seen if the nose is too.
    points = q.index_select(1, c.head_points)
    seen = valid.index_select(1, c.head_points)
    pairs = points[:, :4].unflatten(1, (2, 2))
    seen_pair = seen[:, :4].unflatten(1, (2, 2)).all(-1) & seen[:, 4:]

    # Their frames: left along the pair, front from its middle to the nose.
    left, wide = _shorten(pairs[:, :, 0] - pairs[:, :, 1])
    front = points[:, 4:] - (pairs[:, :, 0] + pairs[:, :, 1]) * 0.5
    front, deep = _shorten(across(left, front))
    frames = torch.stack([left, torch.linalg.cross(front, left), front], dim=-1)
    ears, eyes = frames.unbind(1)

    # Blended by how long the baselines are.
    share = torch.where(seen_pair.unsqueeze(-1), wide * deep, 0.0).unsqueeze(-1)
    by_ears, by_eyes = share.unbind(1)
    head = by_eyes * (eyes @ c.head_from_eyes) + (1 - by_eyes) * chest
    head = by_ears * ears + (1 - by_ears) * head
    return rotation_from_6d(rotation_to_6d(head)).unsqueeze(1)


def palms_of(q: Tensor, chest: Tensor, c: Constants) -> Tensor:
    """``[B, hands, 3, 3]`` palm frames; a degenerate palm gets the chest's ``[B, 1, 3, 3]``.

    Fingers' swings then start from the palm, which turns with the forearm as no bone shows.
    """
    frames = palm_frames(q.index_select(1, c.palms).unflatten(1, (-1, 3)))

    # A palm whose landmarks coincide has a frame of zeros.
    lost = frames.square().sum((-2, -1), keepdim=True) < MIN_SQUARES
    return torch.where(lost, chest, frames)


def _fade(v: Tensor, fallback: Tensor) -> Tensor:
    """Unit v; below `MIN_LENGTH` it fades to the unit ``fallback``, which it equals at 0.

    No continuous map from the ball to the sphere is the identity on the surface, so one point must
    jump: here the v opposite to the fallback, where the two cancel.
    """
    # In units of the minimum length, the fallback's share is 1 - |v|².
    v = v / MIN_LENGTH
    v = v + (1 - squared_norm(v)).clamp_min(0) * fallback
    lost = squared_norm(v) < FOLDED
    return unit(torch.where(lost, fallback, v))


def _shorten(v: Tensor) -> tuple[Tensor, Tensor]:
    """v divided by the larger of its length and `MIN_LENGTH`, and the result's squared length."""
    # Clamped as a square: the root of 0 has no gradient.
    length2 = squared_norm(v)
    shortened = v * length2.clamp_min(MIN_LENGTH**2).rsqrt()
    return shortened, (length2 / MIN_LENGTH**2).clamp_max(1)


def omega(
    p: Tensor,
    valid: Tensor | None,
    R_cam: Tensor,
    template: SkeletonTemplate = MEDIAPIPE33,
    *,
    frames: BoneFrames | None = None,
) -> Tensor:
    """The 6D pose code Ω, incoming-bone convention.

    Joint j has the rotation of the bone that ends at j relative to its parent's frame. Hips have
    the pelvis and shoulders the chest, in camera axes, so that the code depends on the viewpoint;
    the nose has the head relative to the chest, the other face joints the swing of their line from
    the middle of the ears. A face's landmarks have their `face_code`, then zeros, in place of a
    rotation. All but hips and shoulders are invariant to rigid motions.

    Args:
        p: ``[B, J, 3]`` finite joints, metres, world frame.
        valid: ``[B, J]`` bool or None.
        R_cam: ``[B, 3, 3]`` world to camera.
        template: names the joints.
        frames: of the same skeletons, if computed already.

    Returns:
        ``[B, J, 6]``, see :func:`rotation_to_6d`.

    Raises:
        ValueError: on a wrong shape.

    Source: ours; pose code of paper Sec. 3.5 (DANBO's input).
    """
    valid = check_skeleton("omega", p, valid, template)
    if R_cam.shape != (len(p), 3, 3):
        raise ValueError(
            f"omega: R_cam must have shape [{len(p)}, 3, 3], got {list(R_cam.shape)}"
        )
    f = frames or bone_frames(p, valid, template)
    c = constants(template, p.device, p.dtype)

    # Pelvis and chest in camera axes.
    pelvis_chest = R_cam.unsqueeze(1) @ f.hubs[:, :HEAD]
    chest = f.hubs[:, CHEST]
    head = f.head

    # Lines from the middle of the ears to the other joints of the face. Offsets from one ear are
    # exact far from the world's origin too.
    ears = p.index_select(1, c.head_points[:2])
    ear = ears[:, :1]
    d = (p.index_select(1, c.face_turned) - ear) - (ears[:, 1:] - ear) * 0.5
    d = d * squared_norm(d).clamp_min(MIN_LENGTH**2).rsqrt()
    face = c.face_swing.to(d @ head)

    # In the order of the joints, then the landmarks of the face.
    rotations = [pelvis_chest, (chest.mT @ head).unsqueeze(1), face, f.local]

    # Each joint picks its rotation from the list.
    by_joint = torch.cat(rotations, dim=1).index_select(1, c.omega_order)
    code = rotation_to_6d(by_joint)
    offsets = face_code(p, head, template)
    if offsets is None:
        return code
    return torch.cat([code, pad(offsets, (0, 3))], dim=1)
