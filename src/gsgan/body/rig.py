"""How the joints of a body turn, and the degrees of freedom that their turns share.

Convention: radians; axes are those of the rest pose. A *turn* is a rotation ``exp(v)`` at a joint,
its axis-angle v linear in the body's numbers; a joint has one or more, applied in order. A *number*
is one degree of freedom: an angle about an axis, spread over the turns of a chain.
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsgan.body.shape import limb_axes
from gsgan.body.skinned import MarkedBody
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.template import CHEST, PELVIS

# joints, and the share of a number that each one takes
Chain = tuple[tuple[str, float], ...]
# along a limb's upper bone, across it, along its lower
Axes = tuple[Tensor, Tensor, Tensor]
# Per role. A limb's twist is smaller near the trunk than at its far end; the forearm's ends at the
# wrist.
FREE: dict[str, Chain] = {
    "spine": (("spine05", 1.0), ("spine03", 1.0), ("spine01", 1.0)),
    "neck": (("neck01", 0.5), ("head", 0.5)),
    "collar": (("clavicle.{}", 1.0),),
    "arm": (("upperarm01.{}", 0.8), ("upperarm02.{}", 0.2)),
    "forearm": (("lowerarm01.{}", 0.5), ("lowerarm02.{}", 0.1), ("wrist.{}", 0.4)),
    "hand": (("wrist.{}", 1.0),),
    "thumb": (("finger1-1.{}", 1.0),),
    "thigh": (("upperleg01.{}", 0.8), ("upperleg02.{}", 0.2)),
    "shank": (("lowerleg01.{}", 1.0),),
    "foot": (("foot.{}", 1.0),),
    "toe": (("toe1-1.{}", 1.0),),
}
SMPL: dict[str, Chain] = {
    "spine": (("spine1", 1.0), ("spine2", 1.0), ("spine3", 1.0)),
    "neck": (("neck", 0.5), ("head", 0.5)),
    "collar": (("{}_collar", 1.0),),
    "arm": (("{}_shoulder", 1.0),),
    "forearm": (("{}_elbow", 0.5), ("{}_wrist", 0.5)),
    "hand": (("{}_wrist", 1.0),),
    "thumb": (("{}_thumb1", 1.0),),
    "thigh": (("{}_hip", 1.0),),
    "shank": (("{}_knee", 1.0),),
    "foot": (("{}_ankle", 1.0),),
    "toe": (("{}_foot", 1.0),),
}
# Standard deviation of each number about the rest pose: wide where a joint turns freely, narrow
# across hinges and where 33 landmarks do not determine the turn. That of `TRUNK` is learnt.
SPREAD = {
    "neck": 0.5,
    "arm": 1.5,
    "arm_twist": 0.7,
    "elbow": 1.5,
    "elbow_side": 0.1,
    "forearm_twist": 0.6,
    "wrist": 0.4,
    "thumb": 0.3,
    "thigh": 1.0,
    "thigh_twist": 0.2,
    "knee": 1.5,
    "knee_side": 0.05,
    "shank_twist": 0.05,
    "foot": 0.4,
    "foot_y": 0.2,
    "foot_z": 0.2,
    "toe": 0.2,
}
# a hinge does not bend backwards; elbows are bent at rest
LEAST = {"knee": -0.1, "elbow": -0.7}
SIDES = {"left": "L", "right": "R"}
SPINE = ("spine1", "spine2", "spine3")  # from the pelvis to the chest
TRUNK = (
    *(f"{joint}_{axis}" for joint in SPINE for axis in "xyz"),
    *(f"{side}_collar_{axis}" for side in SIDES for axis in "yz"),
)
BENT = 0.15  # sine: an elbow that is bent more at rest determines its hinge
AT_JOINT = 1e-4  # metres
XYZ = ("x", "y", "z")


@dataclass(frozen=True)
class Limb:
    """An arm or a leg, for the first guess.

    Args:
        hub: the bone frame that it hangs on, `PELVIS` or `CHEST`.
        points: landmarks of its first, middle and end joint.
        numbers: of the swing's two axes, the twist, and the hinge.
        axes: ``[3, 3]`` of the swing, the first as near to the hinge as can be; and of the twist,
            along the upper bone.
        bend: at rest, radians.
    """

    hub: int
    points: tuple[int, int, int]
    numbers: tuple[int, int, int, int]
    axes: Tensor
    bend: float


@dataclass(frozen=True)
class BodyRig:
    """T turns and D numbers of a body; one entry for every turn that a number moves.

    Args:
        names: of the numbers; the first six are the root's rotation and translation.
        joint: ``[T]`` the joint of each turn, the root's first.
        parent: ``[T]`` the turn before it on the way to the root, -1 for the root's.
        entry_turn, entry_number: ``[E]``.
        entry_axis: ``[E, 3]`` axis times share.
        carrier: ``[33]`` the turn that each landmark follows.
        reaches: ``[D, 33]`` bool, the landmarks that a number moves.
        limbs: arms and legs.
    """

    names: tuple[str, ...]
    joint: Tensor
    parent: Tensor
    entry_turn: Tensor
    entry_number: Tensor
    entry_axis: Tensor
    carrier: Tensor
    reaches: Tensor
    limbs: tuple[Limb, ...]

    def numbers(self, name: str) -> list[int]:
        """The numbers about x, y and z of a name."""
        return [self.names.index(f"{name}_{k}") for k in XYZ]


class _Turns(list[tuple[int, dict[str, Tensor]]]):
    """Turns in order: joint, and axis by number; shared numbers appear in several."""

    def __init__(
        self, body: MarkedBody, chains: dict[str, Chain], side: str = ""
    ) -> None:
        self.body = body
        self.chains = chains
        self.side = side

    def joint(self, role: str, k: int = 0) -> int | None:
        name = self.chains[role][k][0].format(self.side)
        return (
            self.body.joint_names.index(name) if name in self.body.joint_names else None
        )

    def put(
        self, role: str, axes: dict[str, Tensor], joints: slice = slice(None)
    ) -> None:
        """One turn for each of a chain's joints that the body has."""
        for k, (_, share) in list(enumerate(self.chains[role]))[joints]:
            if (joint := self.joint(role, k)) is not None:
                self.append(
                    (joint, {name: share * axis for name, axis in axes.items()})
                )


def build_rig(body: MarkedBody) -> BodyRig:
    """The rig of the free body or of a model of SMPL's family.

    Raises:
        ValueError: when the joints are named as in neither.
    """
    chains = next(
        (c for c in (FREE, SMPL) if c["spine"][0][0] in body.joint_names), None
    )
    if chains is None:
        raise ValueError(
            f"build_rig: the joints must be the free body's, SMPL's or SMPL-X's, got "
            f"{', '.join(body.joint_names[:3])} ..."
        )
    axes = dict(zip(XYZ, rest_axes(body), strict=True))
    turns = _Turns(body, chains)
    turns.append(
        (0, {f"root_{k}": axis for k, axis in zip(XYZ, torch.eye(3), strict=True)})
    )
    for k, joint in enumerate(SPINE):
        turns.put(
            "spine", {f"{joint}_{i}": axis for i, axis in axes.items()}, slice(k, k + 1)
        )
    turns.put("neck", {f"neck_{k}": axis for k, axis in axes.items()})
    limbs: dict[str, Axes] = {}
    for side, letter in SIDES.items():
        of_side = _Turns(body, chains, letter if chains is FREE else side)
        limbs |= _arm(of_side, side, axes) | _leg(of_side, side, axes)
        turns += of_side
    return _rig(body, turns, limbs)


def _arm(turns: _Turns, side: str, axes: dict[str, Tensor]) -> dict[str, Axes]:
    along = limb_axes(turns.body)
    upper = along[turns.joint("arm")]
    lower = along[turns.joint("forearm")]
    hinge = torch.linalg.cross(upper, lower)
    if hinge.norm() < BENT:
        hinge = torch.linalg.cross(lower, axes["z"])
    hinge = normalize(hinge, dim=0)
    flat = _across(hinge, upper)
    across = torch.linalg.cross(lower, hinge)
    first = slice(0, 1)
    named = f"{side}_arm"
    turns.put("collar", {f"{side}_collar_{k}": axes[k] for k in "yz"})
    turns.put(
        "arm",
        {f"{named}_a": flat, f"{named}_b": torch.linalg.cross(upper, flat)},
        first,
    )
    turns.put("arm", {f"{named}_twist": upper})
    turns.put("forearm", {f"{side}_elbow": hinge}, first)
    turns.put("forearm", {f"{side}_elbow_side": across}, first)
    turns.put("forearm", {f"{side}_forearm_twist": lower})
    turns.put("hand", {f"{side}_wrist_a": hinge, f"{side}_wrist_b": across})
    turns.put("thumb", {f"{side}_thumb_{k}": axis for k, axis in axes.items()})
    return {f"{side} arm shoulder elbow wrist": (upper, flat, lower)}


def _leg(turns: _Turns, side: str, axes: dict[str, Tensor]) -> dict[str, Axes]:
    along = limb_axes(turns.body)
    thigh = along[turns.joint("thigh")]
    shank = along[turns.joint("shank")]
    flat = _across(axes["x"], thigh)
    knee = _across(axes["x"], shank)
    first = slice(0, 1)
    named = f"{side}_thigh"
    turns.put(
        "thigh",
        {f"{named}_a": flat, f"{named}_b": torch.linalg.cross(thigh, flat)},
        first,
    )
    turns.put("thigh", {f"{named}_twist": thigh})
    turns.put("shank", {f"{side}_knee": knee})
    tilt = torch.linalg.cross(shank, knee)
    turns.put("shank", {f"{side}_knee_side": tilt, f"{side}_shank_twist": shank})
    turns.put("foot", {f"{side}_foot_{k}": axis for k, axis in axes.items()})
    turns.put("toe", {f"{side}_toe": axes["x"]})
    return {f"{side} thigh hip knee ankle": (thigh, flat, shank)}


def rest_axes(body: MarkedBody) -> tuple[Tensor, Tensor, Tensor]:
    """Unit left, up and front of the rest pose, from its hips and shoulders."""
    (l_sh, r_sh), (l_hip, r_hip) = (
        body.landmarks[list(pair)] for pair in (MEDIAPIPE33.shoulders, MEDIAPIPE33.hips)
    )
    left = normalize(l_hip - r_hip, dim=0)
    up = _across(l_sh + r_sh - l_hip - r_hip, left)
    return left, up, torch.linalg.cross(left, up)


def _across(v: Tensor, along: Tensor) -> Tensor:
    """The unit part of ``v [3]`` orthogonal to the unit ``along [3]``."""
    return normalize(v - (v @ along) * along, dim=0)


def _rig(body: MarkedBody, turns: _Turns, limbs: dict[str, Axes]) -> BodyRig:
    depth = [0]
    for parent in body.parents[1:]:
        depth.append(depth[parent] + 1)
    # stable: a joint's keep their order
    ordered = sorted(turns, key=lambda turn: depth[turn[0]])
    found = list(dict.fromkeys(name for _, axes in ordered for name in axes))
    names = (*found[:3], *(f"transl_{k}" for k in XYZ), *found[3:])
    last = {joint: i for i, (joint, _) in enumerate(ordered)}

    def carrier(joint: int) -> int:
        while joint not in last:
            joint = body.parents[joint]
        return last[joint]

    parents = [-1]
    for i, (joint, _) in enumerate(ordered[1:], start=1):
        same = ordered[i - 1][0] == joint
        parents.append(i - 1 if same else carrier(body.parents[joint]))
    entries = [
        (i, names.index(n), axis)
        for i, (_, axes) in enumerate(ordered)
        for n, axis in axes.items()
    ]
    turn, number, axis = (list(column) for column in zip(*entries, strict=True))
    joints = torch.tensor([joint for joint, _ in ordered])
    carriers = torch.tensor([carrier(int(j)) for j in body.landmark_bone])
    # a joint's turn does not move a landmark at the joint
    there = (body.landmarks[:, None] - body.joints[joints]).norm(dim=-1) < AT_JOINT
    moved = (ancestors(torch.tensor(parents))[carriers] & ~there).mT  # [T, 33]
    reaches = torch.zeros(len(names), len(carriers), dtype=torch.bool)
    for i, d in zip(turn, number, strict=True):
        reaches[d] |= moved[i]
    return BodyRig(
        names=names,
        joint=joints,
        parent=torch.tensor(parents),
        entry_turn=torch.tensor(turn),
        entry_number=torch.tensor(number),
        entry_axis=torch.stack(axis),
        carrier=carriers,
        reaches=reaches,
        limbs=tuple(_limb(names, *item) for item in limbs.items()),
    )


def prior(rig: BodyRig) -> tuple[Tensor, Tensor]:
    """``[D, D]`` the precision matrix of the numbers about the rest pose, 0 for the root's; and
    ``[D]`` the least value of each."""
    spread = [torch.inf] * 6
    least = [-torch.inf] * 6
    for name in rig.names[6:]:
        key = name.removeprefix("left_").removeprefix("right_")
        known = (
            torch.inf if name in TRUNK else SPREAD.get(key) or SPREAD[key.split("_")[0]]
        )
        spread.append(known)
        least.append(LEAST.get(key, -torch.inf))
    precision = torch.tensor(spread).square().reciprocal().diag()
    trunk = torch.tensor([rig.names.index(name) for name in TRUNK])
    precision[trunk[:, None], trunk] = trunk_covariance().inverse().float()
    return precision, torch.tensor(least)


@lru_cache(maxsize=1)
def trunk_covariance() -> Tensor:
    """``[13, 13]`` square radians, float64: of `TRUNK`, learnt by scripts/learn_trunk.py.

    It says how the bends of spine and collarbones go together, which landmarks of hips and
    shoulders leave open: each pair shows neither the pitch of the pelvis nor that of the chest.

    Source: motions of the CMU Graphics Lab Motion Capture Database; see ATTRIBUTION.md.
    """
    values = json.loads((Path(__file__).with_name("assets") / "trunk.json").read_text())
    return torch.tensor(values["covariance"], dtype=torch.float64)


def _limb(names: tuple[str, ...], words: str, axes: Axes) -> Limb:
    side, limb, *joints = words.split()
    along, flat, lower = axes
    first, middle, end = (
        MEDIAPIPE33.names.index(f"{side}_{joint}") for joint in joints
    )
    numbers = [f"{side}_{limb}_{k}" for k in ("a", "b", "twist")] + [
        f"{side}_{joints[1]}"
    ]
    a, b, twist, hinge = map(names.index, numbers)
    bend = torch.atan2(torch.linalg.cross(along, lower).norm(), along @ lower)
    frame = torch.stack([flat, torch.linalg.cross(along, flat), along])
    hub = CHEST if limb == "arm" else PELVIS
    return Limb(hub, (first, middle, end), (a, b, twist, hinge), frame, float(bend))


def ancestors(parent: Tensor) -> Tensor:
    """``[T, T]`` bool: whether the turn of a row follows that of a column, itself included."""
    above = torch.eye(len(parent), dtype=torch.bool)
    for i, p in enumerate(parent.tolist()):
        if p >= 0:
            above[i] |= above[p]
    return above
