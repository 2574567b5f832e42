"""A skeleton template as tensors, and the shortest rotations (swings) from its directions."""

from __future__ import annotations

from functools import lru_cache
from itertools import chain
from typing import NamedTuple

import torch
from torch import Tensor

from gsgan.skeleton.rotation6d import across, orthogonal_to, unit
from gsgan.skeleton.template import (
    CHEST,
    HEAD,
    N_HUBS,
    PELVIS,
    SkeletonTemplate,
)
from gsgan.utils.tensors import squared_norm

FOLDED = 1e-4
"""A swing with ``1 + cos(angle)`` below this is composed via the opposite direction."""


class Swing(NamedTuple):
    """The shortest rotations from fixed unit directions ``rest [M, 3]`` to any other."""

    rest: Tensor
    straight: Tensor  # [M, 3, 3] first half turn of usual swings
    # [M, 3, 3] first two half turns of nearly opposite directions
    folded: Tensor

    @classmethod
    def of(cls, rest: Tensor) -> Swing:
        """The swings from these directions."""
        straight = _half_turn(rest)
        folded = straight @ _half_turn(orthogonal_to(rest))
        return cls(rest, straight, folded)

    def to(self, d: Tensor) -> Tensor:
        """``[B, M, 3, 3]`` rotations from ``rest`` to the directions ``d [B, M, 3]``.

        A d shorter than 1 gives a part of the rotation, a zero d none.

        The swing is composed of two half turns, about ``rest`` and about the bisector of ``rest``
        and ``d``, without a division by ``1 + cos``. If ``1 + cos < FOLDED``, the bisector is
        undefined and a third half turn, about a fixed axis orthogonal to ``rest``, goes first: the
        result still maps ``rest`` exactly to ``d``, with an arbitrary but fixed roll.
        """
        cos = (self.rest * d).sum(-1, keepdim=True)
        is_folded = cos + 1.0 < FOLDED
        w = d + torch.where(is_folded, -self.rest, self.rest)
        first = torch.where(is_folded.unsqueeze(-1), self.folded, self.straight)
        return _half_turn(w) @ first


def _half_turn(axis: Tensor) -> Tensor:
    """``[..., 3, 3]``: ``2 a aᵀ / |a|² - I``, by half a turn about ``axis [..., 3]``."""
    scaled = axis * (2.0 / squared_norm(axis))
    eye = torch.eye(3, dtype=axis.dtype, device=axis.device)
    return scaled.unsqueeze(-1) * axis.unsqueeze(-2) - eye


class Level(NamedTuple):
    """Limbs of one depth: their parents' frames are in earlier levels."""

    limbs: Tensor  # [M] into the template's limbs
    parents: Tensor  # [M] into the frames so far: hubs, then limbs by level
    swing: Swing


class Constants(NamedTuple):
    """A template as tensors."""

    rest: Tensor  # [J, 3] metres
    starts: Tensor  # [L] joints where limbs start
    ends: Tensor  # [L] joints where limbs end
    levels: tuple[Level, ...]  # limbs by depth
    limb_order: Tensor  # [L] undoes the sorting by level
    head_from_eyes: Tensor  # [3, 3] the head's axes in those of eyes and nose
    head_points: Tensor  # [5] left ear, right ear, left eye, right eye, nose
    torso: Tensor  # [4] left and right shoulder, left and right hip
    # [3 H] wrist, index's and little finger's knuckle of each hand
    palms: Tensor
    measured: Tensor  # limbs that measure the subject's size
    fingers: Tensor  # limbs that are bones of hands
    face_turned: Tensor  # [F] face joints but the nose
    face_swing: Swing  # of their lines from the middle of the ears
    expression: Tensor  # [E] landmarks of a face
    face_rest: Tensor  # [E, 3] metres, from the middle of the head's points
    omega_order: Tensor  # [J - E] into pelvis, chest, head, face, limbs
    axes: Tensor  # [3, 3] world axes


@lru_cache(maxsize=64)
def constants(
    template: SkeletonTemplate, device: torch.device, dtype: torch.dtype
) -> Constants:
    """The template's tensors on a device, cached."""
    # Tensors created in inference mode cannot be used for training later.
    with torch.inference_mode(False), torch.no_grad():
        return _constants(template, device, dtype)


def _constants(
    t: SkeletonTemplate, device: torch.device, dtype: torch.dtype
) -> Constants:
    def index(values: object) -> Tensor:
        return torch.tensor(values, dtype=torch.int64, device=device)

    def cast(value: Tensor) -> Tensor:
        return value.to(device=device, dtype=dtype)

    def swing(rest: Tensor) -> Swing:
        return Swing(*(cast(part) for part in Swing.of(rest)))

    # In float64 first: constants are then correct to the last bit of their dtype.
    rest = torch.tensor(t.rest_positions, dtype=torch.float64)
    directions = torch.tensor(t.rest_directions, dtype=torch.float64)

    # Limbs by level, each with the position of its parent's frame.
    ordered = list(chain.from_iterable(t.levels))

    # Frames are stored hubs first, then limbs level by level.
    starts, ends = zip(*t.limbs, strict=True)
    position = dict(enumerate(range(t.n_hubs)))
    for k, limb in enumerate(ordered):
        position[t.n_hubs + limb] = t.n_hubs + k
    levels = []
    for limbs in t.levels:
        parents = [position[t.limb_parents[limb]] for limb in limbs]
        levels.append(
            Level(
                limbs=index(limbs),
                parents=index(parents),
                swing=swing(directions[list(limbs)]),
            )
        )

    # The face's joints but the nose turn with their line from the middle of the ears.
    turned = [j for j in t.face if j != t.nose]
    from_ears = rest[turned] - rest[list(t.ears)].mean(0)

    # Where omega finds each joint's rotation: among pelvis, chest, head, face and limbs.
    place = dict.fromkeys(t.hips, PELVIS)
    place |= dict.fromkeys(t.shoulders, CHEST)
    place[t.nose] = HEAD
    for k, joint in enumerate(turned):
        place[joint] = N_HUBS + k
    for joint, limb in t.incoming.items():
        place[joint] = N_HUBS + len(turned) + limb
    posed = [
        joint for joint in range(len(t.names)) if joint not in t.expression
    ]

    # Everything on the device, in the dtype of the skeletons.
    return Constants(
        rest=cast(rest),
        starts=index(starts),
        ends=index(ends),
        levels=tuple(levels),
        limb_order=index([ordered.index(limb) for limb in range(len(t.limbs))]),
        head_from_eyes=cast(_eye_frame(t, rest).mT.contiguous()),
        head_points=index(t.head),
        torso=index(t.torso),
        palms=index(list(chain.from_iterable(t.palms))),
        measured=index(t.measured),
        fingers=index(t.fingers),
        face_turned=index(turned),
        face_swing=swing(from_ears / from_ears.norm(dim=-1, keepdim=True)),
        expression=index(t.expression),
        face_rest=cast(rest[list(t.expression)] - rest[list(t.head)].mean(0)),
        omega_order=index([place[joint] for joint in posed]),
        axes=cast(torch.eye(3, dtype=torch.float64)),
    )


def _eye_frame(t: SkeletonTemplate, rest: Tensor) -> Tensor:
    """``[3, 3]``: the frame of eyes and nose at rest, whose head frame is the identity."""
    # The axes are across the eyes, up, and to the front.
    left, right = t.eyes
    middle = (rest[left] + rest[right]) / 2
    across_eyes = unit(rest[left] - rest[right])
    front = unit(across(across_eyes, rest[t.nose] - middle))
    up = torch.linalg.cross(front, across_eyes)
    return torch.stack([across_eyes, up, front], dim=-1)


def check_skeleton(
    owner: str, p: Tensor, valid: Tensor | None, template: SkeletonTemplate
) -> Tensor:
    """The validity mask, all true when None.

    Raises:
        ValueError: naming the argument, when a shape does not match the template.
    """
    # The joints must be those of the template.
    joints = len(template.names)
    if p.ndim != 3 or p.shape[1:] != (joints, 3) or not p.is_floating_point():
        raise ValueError(
            f"{owner}: p must be a float tensor of shape [B, {joints}, 3], "
            f"got {p.dtype} {list(p.shape)}"
        )
    if valid is None:
        return torch.ones(p.shape[:2], dtype=torch.bool, device=p.device)

    # The mask must be of the same skeletons.
    if valid.shape != p.shape[:2] or valid.dtype != torch.bool:
        raise ValueError(
            f"{owner}: valid must be a bool tensor of shape {list(p.shape[:2])}, "
            f"got {valid.dtype} {list(valid.shape)}"
        )
    return valid
