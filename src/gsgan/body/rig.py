"""The joints of a body as anatomy: which way each one turns, how far, and what it shares.

Convention: a *turn* is a rotation ``exp(M q)`` at a joint, M linear in the body's numbers q; a joint
has one or more, applied in order. Axes are those of the rest pose, metres and radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gsgan.body.shape import limb_axes
from gsgan.body.skinned import MarkedBody
from gsgan.skeleton import MEDIAPIPE33

# Joints by role, in the free body | in SMPL's family, with the share of the chain's turn each takes.
Chain = tuple[tuple[str, float], ...]
FREE: dict[str, Chain] = {
    "spine": (("spine05", 1 / 3), ("spine03", 1 / 3), ("spine01", 1 / 3)),
    "neck": (("neck01", 0.5), ("head", 0.5)),
    "collar": (("clavicle.{}", 1.0),),
    "upper_arm": (("upperarm01.{}", 0.8), ("upperarm02.{}", 0.2)),
    "forearm": (("lowerarm01.{}", 0.5), ("lowerarm02.{}", 0.1), ("wrist.{}", 0.4)),
    "hand": (("wrist.{}", 1.0),),
    "thumb": (("finger1-1.{}", 1.0),),
    "thigh": (("upperleg01.{}", 0.8), ("upperleg02.{}", 0.2)),
    "shank": (("lowerleg01.{}", 1.0),),
    "foot": (("foot.{}", 1.0),),
    "toe": (("toe1-1.{}", 1.0),),
}
SMPL: dict[str, Chain] = {
    "spine": (("spine1", 1 / 3), ("spine2", 1 / 3), ("spine3", 1 / 3)),
    "neck": (("neck", 0.5), ("head", 0.5)),
    "collar": (("{}_collar", 1.0),),
    "upper_arm": (("{}_shoulder", 1.0),),
    "forearm": (("{}_elbow", 0.5), ("{}_wrist", 0.5)),
    "hand": (("{}_wrist", 1.0),),
    "thumb": (("{}_thumb1", 1.0),),
    "thigh": (("{}_hip", 1.0),),
    "shank": (("{}_knee", 1.0),),
    "foot": (("{}_ankle", 1.0),),
    "toe": (("{}_foot", 1.0),),
}
SIDES = {"left": "L", "right": "R"}
BENT = 0.15  # radians: from here on the rest pose's own bend shows where the elbow's hinge is


@dataclass(frozen=True)
class Rig:
    """A body's turns and numbers.

    Args:
        joint: ``[T]`` the body's joint of each turn, the root's first.
        parent: ``[T]`` the turn before it on the way from the root; -1 for the root's.
        M: ``[T, 3, D]`` what the numbers turn; the root's own six numbers come first.
        names: of the D numbers.
        carrier: ``[33]`` the turn that each landmark follows.
        reaches: ``[D, 33]`` bool, the landmarks that a number moves.
    """

    joint: Tensor
    parent: Tensor
    M: Tensor
    names: tuple[str, ...]
    carrier: Tensor
    reaches: Tensor

    def number(self, name: str) -> int:
        return self.names.index(name)


@dataclass
class _Builder:
    body: MarkedBody
    turns: list[tuple[int, dict[str, Tensor]]] = field(default_factory=list)

    def add(self, chain: Chain, side: str, **axes: Tensor) -> None:
        """Turns about named axes ``[3]``, spread over a chain's joints; one turn per joint."""
        for pattern, share in chain:
            name = pattern.format(side)
            if name in self.body.joint_names:
                joint = self.body.joint_names.index(name)
                self.turns.append((joint, {k: share * axis for k, axis in axes.items()}))


def build_rig(body: MarkedBody) -> Rig:
    """The rig of the free body or of a model of SMPL's family.

    Raises:
        ValueError: when the joints are not named as in one of them.
    """
    free = "spine05" in body.joint_names
    chains = FREE if free else SMPL
    if chains["spine"][0][0] not in body.joint_names:
        raise ValueError(f"build_rig: unknown joints {', '.join(body.joint_names[:4])} ...")
    made = _Builder(body)
    left, up, front = rest_axes(body)
    along = limb_axes(body)
    full = {"x": left, "y": up, "z": front}
    eye = {
        "x": torch.tensor([1.0, 0, 0]),
        "y": torch.tensor([0, 1.0, 0]),
        "z": torch.tensor([0, 0, 1.0]),
    }
    made.turns.append((0, {f"root_{k}": a.to(left) for k, a in eye.items()}))
    made.add(chains["spine"], "", **{f"spine_{k}": a for k, a in full.items()})
    made.add(chains["neck"], "", **{f"neck_{k}": a for k, a in full.items()})
    for side, letter in SIDES.items():
        s = letter if free else side
        index = {
            role: body.joint_names.index(chain[0][0].format(s))
            for role, chain in chains.items()
            if chain[0][0].format(s) in body.joint_names
        }
        upper, lower = along[index["upper_arm"]], along[index["forearm"]]
        hinge = torch.linalg.cross(upper, lower)
        if hinge.norm() < BENT:
            hinge = torch.linalg.cross(lower, front)
        hinge = hinge / hinge.norm()
        e1 = hinge - (hinge @ upper) * upper
        e1 = e1 / e1.norm()
        made.add(chains["collar"], s, **{f"{side}_collar_y": up, f"{side}_collar_z": front})
        made.add(
            chains["upper_arm"][:1],
            s,
            **{f"{side}_arm_a": e1, f"{side}_arm_b": torch.linalg.cross(upper, e1)},
        )
        made.add(chains["upper_arm"], s, **{f"{side}_arm_twist": upper})
        across = torch.linalg.cross(lower, hinge)
        made.add(chains["forearm"][:1], s, **{f"{side}_elbow": hinge})
        made.add(chains["forearm"][:1], s, **{f"{side}_elbow_side": across})
        made.add(chains["forearm"], s, **{f"{side}_forearm_twist": lower})
        made.add(chains["hand"], s, **{f"{side}_wrist_a": hinge, f"{side}_wrist_b": across})
        made.add(chains["thumb"], s, **{f"{side}_thumb_{k}": a for k, a in full.items()})
        thigh, shank = along[index["thigh"]], along[index["shank"]]
        e1 = left - (left @ thigh) * thigh
        e1 = e1 / e1.norm()
        made.add(
            chains["thigh"][:1],
            s,
            **{f"{side}_thigh_a": e1, f"{side}_thigh_b": torch.linalg.cross(thigh, e1)},
        )
        made.add(chains["thigh"], s, **{f"{side}_thigh_twist": thigh})
        knee = left - (left @ shank) * shank
        knee = knee / knee.norm()
        made.add(chains["shank"], s, **{f"{side}_knee": knee})
        made.add(
            chains["shank"],
            s,
            **{f"{side}_knee_side": torch.linalg.cross(shank, knee), f"{side}_shank_twist": shank},
        )
        made.add(chains["foot"], s, **{f"{side}_foot_{k}": a for k, a in full.items()})
        made.add(chains["toe"], s, **{f"{side}_toe": left})
    return _finished(made)


def rest_axes(body: MarkedBody) -> tuple[Tensor, Tensor, Tensor]:
    """Unit left, up and front of the rest pose, from its hips and shoulders."""
    at = dict(zip(MEDIAPIPE33.names, body.landmarks, strict=True))
    left = at["left_hip"] - at["right_hip"]
    left = left / left.norm()
    up = at["left_shoulder"] + at["right_shoulder"] - at["left_hip"] - at["right_hip"]
    up = up - (up @ left) * left
    up = up / up.norm()
    return left, up, torch.linalg.cross(left, up)


def _finished(made: _Builder) -> Rig:
    body = made.body
    # by depth and then in the order given, so that a turn follows those before it
    depth = [0] * len(body.parents)
    for j, parent in enumerate(body.parents):
        depth[j] = 0 if parent < 0 else depth[parent] + 1
    turns = sorted(made.turns, key=lambda turn: depth[turn[0]])
    names = list(dict.fromkeys(name for _, axes in turns for name in axes))
    names = [*names[:3], "transl_x", "transl_y", "transl_z", *names[3:]]
    M = torch.zeros(len(turns), 3, len(names))
    for i, (_, axes) in enumerate(turns):
        for name, axis in axes.items():
            M[i, :, names.index(name)] = axis
    last = {joint: i for i, (joint, _) in enumerate(turns)}

    def carrier(joint: int) -> int:
        while joint not in last:
            joint = body.parents[joint]
        return last[joint]

    parents: list[int] = []
    for i, (joint, _) in enumerate(turns):
        same = [k for k in range(i) if turns[k][0] == joint]
        parents.append(same[-1] if same else -1 if i == 0 else carrier(body.parents[joint]))
    above = torch.eye(len(turns), dtype=torch.bool)
    for i, parent in enumerate(parents[1:], start=1):
        above[i] |= above[parent]
    carriers = torch.tensor([carrier(int(j)) for j in body.landmark_bone])
    # a landmark at the joint itself does not move with it
    offset = body.landmarks[:, None] - body.joints[[j for j, _ in turns]]
    moved = above[carriers] & ~(offset.norm(dim=-1) < 1e-4)
    reaches = (moved.float() @ (M != 0).any(1).float() > 0).mT
    reaches[:6] = True
    return Rig(
        joint=torch.tensor([j for j, _ in turns]),
        parent=torch.tensor(parents),
        M=M,
        names=tuple(names),
        carrier=carriers,
        reaches=reaches,
    )
