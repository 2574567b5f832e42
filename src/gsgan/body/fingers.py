"""Finger joints of a body from the 21 landmarks of each hand.

Convention: metres, radians; a joint's turn is its axis-angle in `BodyPose.theta`.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from gsgan.body.free import Body
from gsgan.body.lbs import axis_angle_to_matrix, shortest_turn
from gsgan.skeleton.hands import FINGERS, HAND, PALM, PINKY, palm_frames

# Least and most flexion, of a finger's from straight, and most turn to the side: of the first
# joint, and of the next one, which stands for the last two where a body has no third.
THUMB = ((-0.8, 1.2, 0.8), (-0.6, 2.0, 0.3))  # from rest
FINGER = ((-0.6, 1.75, 0.45), (-0.2, 2.6, 0.0))
LEAST = 1e-4  # of a bone at rest, added to the seen one: a bone that vanishes rests


class _Joint(NamedTuple):
    joint: int  # of the body
    own: int  # the landmark that lies there
    points: tuple[int, ...]  # landmarks up to the next joint
    thumb: bool


class Fingers(nn.Module):
    """Turns of a body's finger joints that point its bones where a hand's landmarks lie.

    Directions in the palm's frame, so that neither the person's proportions nor an error of the
    solved wrist matters: joint by joint from the palm on, the shortest turn to the direction of the
    landmarks that the joint moves, within anatomical limits. Second joints of the four fingers are
    hinges.

    Args:
        body: with hand landmarks, in the subject's shape; two joints a finger.

    Source: ours.
    """

    rest: Tensor  # [42, 3]
    palms: Tensor  # [2, 3, 3]
    joints: Tensor  # [20] of the body: each finger's first joint, then each one's second
    own: Tensor  # [20] the landmark at the joint
    moved: Tensor  # [20, 42] 1 where a landmark gives its direction
    axes: Tensor  # [20, 2, 3] of flexion, and of turns to the side
    least: Tensor  # [20, 2]
    most: Tensor  # [20, 2]

    def __init__(self, body: Body) -> None:
        super().__init__()
        rest, rows = body.hand_landmarks, _joints(body.hand_bone.tolist())
        own, self.half = torch.tensor([row.own for row in rows]), len(rows) // 2
        moved = torch.stack([rest.new_zeros(len(rest)).index_fill_(0, torch.tensor(row.points), 1)
                             for row in rows])  # fmt: skip
        limits = rest.new_tensor([(THUMB if row.thumb else FINGER)[i >= self.half]
                                  for i, row in enumerate(rows)])  # fmt: skip
        low, high, side = limits.unbind(-1)
        palms = palm_frames(rest.unflatten(0, (2, HAND))[:, PALM])
        with torch.no_grad():
            axes, bend = _axes(_bones(rest, moved, own), rest, palms, rows)
        held = {
            "rest": rest,
            "palms": palms,
            "joints": torch.tensor([row.joint for row in rows]),
            "own": own,
            "moved": moved,
            "axes": axes,
            "least": torch.stack([low - bend, -side], dim=-1),
            "most": torch.stack([high - bend, side], dim=-1),
        }
        for name, value in held.items():
            self.register_buffer(name, value, persistent=False)

    def forward(self, hands: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
        """Turns ``[B, 20, 3]`` of `joints`, and which of them are shown ``[B, 20]`` bool; others
        hold anything finite.

        Args:
            hands: ``[B, 42, 3]`` metres, finite, in any axes.
            seen: ``[B, 42]`` bool. A hand needs its wrist and the knuckles of index and little
                finger; a joint its own landmark and one that it moves.
        """
        frames = palm_frames(hands.unflatten(1, (2, HAND))[:, :, PALM])
        R = (frames @ self.palms.mT).repeat_interleave(HAND, dim=1)
        q = (hands.unsqueeze(-2) @ R).squeeze(-2)  # with the palms as they rest
        weight = self.moved * seen.unsqueeze(1)
        rests, bones = (
            _bones(x, weight, self.own).split(self.half, dim=1) for x in (self.rest.expand_as(q), q)
        )
        parts = (x.split(self.half) for x in (self.axes, self.least, self.most))
        before, turns = torch.eye(3).to(q), []
        for rest, bone, axes, least, most in zip(rests, bones, *parts, strict=True):
            now = (bone.unsqueeze(-2) @ before).squeeze(-2) + LEAST * rest
            hinge = (most[:, 1:] == 0) * axes[:, 0]
            flat = (x - (x * hinge).sum(-1, keepdim=True) * hinge for x in (rest, now))
            turn = shortest_turn(*(normalize(x, dim=-1, eps=1e-9) for x in flat))
            numbers = (axes @ turn.unsqueeze(-1)).squeeze(-1).clamp(least, most)
            turns.append((numbers.unsqueeze(-2) @ axes).squeeze(-2))
            before = before @ axis_angle_to_matrix(turns[-1])
        return torch.cat(turns, dim=1), self.shown(seen)

    def shown(self, seen: Tensor) -> Tensor:
        """``[B, 20]`` bool: the joints that landmarks ``seen [B, 42]`` bool show."""
        palm = seen.unflatten(1, (2, HAND))[:, :, PALM].all(-1)
        moved = (self.moved * seen.unsqueeze(1)).sum(-1) > 0
        first, second = (moved & seen[:, self.own]).split(self.half, dim=1)
        first = first & palm.repeat_interleave(len(FINGERS), dim=1)
        return torch.cat([first, first & second], dim=1)


def _joints(bones: list[int]) -> list[_Joint]:
    """Each finger's first joint, left hand first, then each one's second.

    Args:
        bones: the joint that each of the 42 landmarks moves with.
    """
    first, second = [], []
    for start in (0, HAND):
        for k, finger in enumerate(FINGERS):
            base, *others = (start + j for j in finger)
            at = next(i for i, j in enumerate(others) if bones[j] != bones[base])
            middle, thumb = others[at], k == 0
            first.append(_Joint(bones[base], base, tuple(others[: at + 1]), thumb))
            second.append(_Joint(bones[middle], middle, tuple(others[at + 1 :]), thumb))
    return first + second


def _bones(x: Tensor, weight: Tensor, own: Tensor) -> Tensor:
    """``[..., K, 3]`` sums of landmarks ``x [..., 42, 3]``, weighted, from those at the joints."""
    return weight @ x - weight.sum(-1, keepdim=True) * x[..., own, :]


def _axes(bones: Tensor, rest: Tensor, palms: Tensor, rows: list[_Joint]) -> tuple[Tensor, Tensor]:
    """Axes ``[K, 2, 3]`` of flexion and of turns to the side; the limits' origin ``[K]``, radians:
    how far a finger is bent at rest."""
    own, half = torch.tensor([row.own for row in rows]), len(rows) // 2
    hand, thumb = own // HAND, torch.tensor([[row.thumb] for row in rows])
    along = normalize(bones, dim=-1)
    out = (palms[..., 2] * palms.new_tensor([[1.0], [-1.0]]))[hand]  # of the palm
    # a thumb bends towards the base of the little finger
    across = rest.unflatten(0, (2, HAND))[:, PINKY][hand] - rest[own]
    flexion = normalize(torch.linalg.cross(along, torch.where(thumb, across, out)), dim=-1)
    before = torch.cat([palms[hand[:half], :, 0], along[:half]])
    bend = torch.linalg.cross(before, along) * flexion
    bend = torch.atan2(bend.sum(-1), (before * along).sum(-1))
    axes = torch.stack([flexion, torch.linalg.cross(along, flexion)], dim=1)
    return axes, torch.where(thumb[:, 0], 0.0, bend)
