"""How the joints of a body turn, and the degrees of freedom that their turns share.

Angles are in radians, axes are those of the rest pose. A *turn* is a rotation ``exp(v)`` at a
joint, its axis-angle v linear in the body's numbers; a joint has one or more, applied in order. A
*number* is one degree of freedom: an angle about an axis, spread over the turns of a chain.
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, pairwise, product
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gsgan.body.shape import limb_axes
from gsgan.body.skinned import MarkedBody
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.template import CHEST, PELVIS

# Joints, and the share of a number that each one takes.
Chain = tuple[tuple[str, float], ...]
# The chain of each role. A limb's twist is smaller near the trunk than at its far end; the
# forearm's ends at the wrist.
FREE: dict[str, Chain] = {
    "spine": (("spine05", 1.0), ("spine03", 1.0), ("spine01", 1.0)),
    "neck": (("neck01", 0.5), ("head", 0.5)),
    "collar": (("clavicle.{}", 1.0),),
    "arm": (("upperarm01.{}", 0.8), ("upperarm02.{}", 0.2)),
    "forearm": (
        ("lowerarm01.{}", 0.5),
        ("lowerarm02.{}", 0.1),
        ("wrist.{}", 0.4),
    ),
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
# Standard deviation of each number about the rest pose: wide if a joint turns freely, narrow
# across hinges and if 33 landmarks do not determine the turn. That of `TRUNK` is learnt.
NUMBER_SIGMAS = {
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
# A hinge does not bend backwards; elbows are bent at rest.
HINGE_MINIMA = {"knee": -0.1, "elbow": -0.7}
SIDE_LETTERS = {"left": "L", "right": "R"}
SPINE = ("spine1", "spine2", "spine3")  # from the pelvis to the chest
TRUNK = (
    *map("_".join, product(SPINE, "xyz")),
    *map("_collar_".join, product(SIDE_LETTERS, "yz")),
)
BENT = 0.15  # sine: an elbow that is bent more at rest determines its hinge
AT_JOINT = 1e-4  # metres
XYZ = ("x", "y", "z")


class LimbAxes(NamedTuple):
    """Unit axes of a limb at rest."""

    upper: Tensor  # [3] along the upper bone
    flat: Tensor  # [3] across it, as near to the hinge as can be
    lower: Tensor  # [3] along the lower bone


class Turn(NamedTuple):
    """A rotation at a joint, and the numbers that it depends on."""

    joint: int
    # axis times share, by number; turns may share numbers
    axes: dict[str, Tensor]


@dataclass(frozen=True)
class Limb:
    """An arm or a leg, for the first guess."""

    hub: int  # the bone frame that it hangs on, `PELVIS` or `CHEST`
    points: tuple[int, int, int]  # landmarks of its first, middle and end joint
    # the swing's two axes, the twist, and the hinge
    numbers: tuple[int, int, int, int]
    # [3, 3] of the swing, the first as near to the hinge as can be; and of the twist, along the
    # upper bone
    axes: Tensor
    bend: float  # at rest, radians


@dataclass(frozen=True)
class BodyRig:
    """T turns and D numbers of a body; one entry for every turn that a number moves."""

    # of the numbers; the first six are the root's rotation and translation
    names: tuple[str, ...]
    joint: Tensor  # [T] the joint of each turn, the root's first
    parent: Tensor  # [T] the turn before it on the way to the root, -1 for the root's
    entry_turn: Tensor  # [E]
    entry_number: Tensor  # [E]
    entry_axis: Tensor  # [E, 3] axis times share
    carrier: Tensor  # [33] the turn that each landmark follows
    reaches: Tensor  # [D, 33] bool, the landmarks that a number moves
    limbs: tuple[Limb, ...]  # arms and legs

    def numbers(self, name: str) -> list[int]:
        """The numbers about x, y and z of a name."""
        return [self.names.index(f"{name}_{k}") for k in XYZ]


class _Turns(list[Turn]):
    """Turns in order, made from the chains of a body's roles on one side."""

    def __init__(
        self, body: MarkedBody, chains: dict[str, Chain], side: str = ""
    ) -> None:
        self.body = body
        self.chains = chains
        self.side = side

    def joint(self, role: str, k: int = 0) -> int | None:
        """The number of a chain's k-th joint, None if the body does not have it."""
        name = self.chains[role][k][0].format(self.side)
        if name not in self.body.joint_names:
            return None
        return self.body.joint_names.index(name)

    def put(
        self, role: str, axes: dict[str, Tensor], joints: slice = slice(None)
    ) -> None:
        """One turn for each of a chain's joints that the body has."""
        for k, (_, share) in list(enumerate(self.chains[role]))[joints]:
            joint = self.joint(role, k)
            if joint is not None:
                shares = {name: share * axis for name, axis in axes.items()}
                self.append(Turn(joint, shares))


def build_rig(body: MarkedBody) -> BodyRig:
    """The rig of the free body or of a model of SMPL's family.

    Raises:
        ValueError: when the joints are named as in neither.
    """
    if "spine05" in body.joint_names:
        chains = FREE
    elif "spine1" in body.joint_names:
        chains = SMPL
    else:
        raise ValueError(
            f"build_rig: the joints must be the free body's, SMPL's or SMPL-X's, got "
            f"{', '.join(body.joint_names[:3])} ..."
        )

    # Root, spine and neck.
    axes = dict(zip(XYZ, rest_axes(body), strict=True))
    world = dict(zip(XYZ, torch.eye(3), strict=True))
    turns = _Turns(body, chains)
    turns.append(Turn(0, _name_axes("root", world)))
    for k, joint in enumerate(SPINE):
        turns.put("spine", _name_axes(joint, axes), slice(k, k + 1))
    turns.put("neck", _name_axes("neck", axes))

    # Arms and legs.
    limbs = {}
    for side, letter in SIDE_LETTERS.items():
        of_side = _Turns(body, chains, letter if chains is FREE else side)
        limbs[f"{side} arm shoulder elbow wrist"] = _arm(of_side, side, axes)
        limbs[f"{side} thigh hip knee ankle"] = _leg(of_side, side, axes)
        turns += of_side
    return _rig(body, turns, limbs)


def _name_axes(name: str, axes: dict[str, Tensor]) -> dict[str, Tensor]:
    return {f"{name}_{k}": axis for k, axis in axes.items()}


def _swing(name: str, along: Tensor, flat: Tensor) -> dict[str, Tensor]:
    """The two axes across a bone."""
    return {f"{name}_a": flat, f"{name}_b": torch.linalg.cross(along, flat)}


def _arm(turns: _Turns, side: str, axes: dict[str, Tensor]) -> LimbAxes:
    """Adds the turns of an arm from the collarbone to the thumb."""
    # Unit directions from shoulder to elbow, and from elbow to wrist.
    along = limb_axes(turns.body)
    upper = along[turns.joint("arm")]
    lower = along[turns.joint("forearm")]

    # The elbow's hinge is across both bones; of a straight arm, across the lower and the front.
    hinge = torch.linalg.cross(upper, lower)
    if hinge.norm() < BENT:
        hinge = torch.linalg.cross(lower, axes["z"])
    hinge = normalize(hinge, dim=0)
    flat = _across(hinge, upper)
    across = torch.linalg.cross(lower, hinge)

    # Of a forearm of several bones, the first has the hinge, and all share the twist.
    first = slice(0, 1)
    collar = {"y": axes["y"], "z": axes["z"]}
    turns.put("collar", _name_axes(f"{side}_collar", collar))
    turns.put("arm", _swing(f"{side}_arm", upper, flat), first)
    turns.put("arm", {f"{side}_arm_twist": upper})
    turns.put("forearm", {f"{side}_elbow": hinge}, first)
    turns.put("forearm", {f"{side}_elbow_side": across}, first)
    turns.put("forearm", {f"{side}_forearm_twist": lower})
    turns.put("hand", {f"{side}_wrist_a": hinge, f"{side}_wrist_b": across})
    turns.put("thumb", _name_axes(f"{side}_thumb", axes))
    return LimbAxes(upper=upper, flat=flat, lower=lower)


def _leg(turns: _Turns, side: str, axes: dict[str, Tensor]) -> LimbAxes:
    """Adds the turns of a leg from the hip to the toes."""
    along = limb_axes(turns.body)
    thigh = along[turns.joint("thigh")]
    shank = along[turns.joint("shank")]

    # The knee's hinge is the left axis, across the shank.
    flat = _across(axes["x"], thigh)
    knee = _across(axes["x"], shank)
    tilt = torch.linalg.cross(shank, knee)

    turns.put("thigh", _swing(f"{side}_thigh", thigh, flat), slice(0, 1))
    turns.put("thigh", {f"{side}_thigh_twist": thigh})
    turns.put("shank", {f"{side}_knee": knee})
    turns.put(
        "shank", {f"{side}_knee_side": tilt, f"{side}_shank_twist": shank}
    )
    turns.put("foot", _name_axes(f"{side}_foot", axes))
    turns.put("toe", {f"{side}_toe": axes["x"]})
    return LimbAxes(upper=thigh, flat=flat, lower=shank)


def rest_axes(body: MarkedBody) -> tuple[Tensor, Tensor, Tensor]:
    """Unit left, up and front of the rest pose, from its hips and shoulders."""
    l_sh, r_sh = body.landmarks[list(MEDIAPIPE33.shoulders)]
    l_hip, r_hip = body.landmarks[list(MEDIAPIPE33.hips)]

    # The spine's part orthogonal to the line of the hips points up.
    left = normalize(l_hip - r_hip, dim=0)
    up = _across(l_sh + r_sh - l_hip - r_hip, left)
    return left, up, torch.linalg.cross(left, up)


def _across(v: Tensor, along: Tensor) -> Tensor:
    """The unit part of ``v [3]`` orthogonal to the unit ``along [3]``."""
    return normalize(v - (v @ along) * along, dim=0)


def _rig(
    body: MarkedBody, turns: _Turns, limbs: dict[str, LimbAxes]
) -> BodyRig:
    """The tensors of turns and limbs."""
    # Turns by the depth of their joints; those of one joint keep their order.
    depth = [0]
    for parent in body.parents[1:]:
        depth.append(depth[parent] + 1)
    ordered = sorted(turns, key=lambda turn: depth[turn.joint])

    # The numbers in the order of the turns, with the root's translation after its rotation.
    axis_names = list(
        dict.fromkeys(chain.from_iterable(turn.axes for turn in ordered))
    )
    names = (*axis_names[:3], *(f"transl_{k}" for k in XYZ), *axis_names[3:])

    # A joint without a turn moves with the last turn of the nearest joint above it.
    last = {turn.joint: i for i, turn in enumerate(ordered)}

    def carrier(joint: int) -> int:
        while joint not in last:
            joint = body.parents[joint]
        return last[joint]

    # The turn before each: of the same joint, else of its parent.
    parents = [-1]
    for i, (before, turn) in enumerate(pairwise(ordered)):
        same = before.joint == turn.joint
        parents.append(i if same else carrier(body.parents[turn.joint]))

    # One entry for every turn that a number moves.
    entry_turn = []
    entry_number = []
    entry_axis = []
    for i, turn in enumerate(ordered):
        for name, axis in turn.axes.items():
            entry_turn.append(i)
            entry_number.append(names.index(name))
            entry_axis.append(axis)

    # A turn moves the landmarks that follow it, except those at its joint.
    joints = torch.tensor([turn.joint for turn in ordered])
    carriers = torch.tensor([carrier(int(j)) for j in body.landmark_bone])
    there = (body.landmarks[:, None] - body.joints[joints]).norm(
        dim=-1
    ) < AT_JOINT
    moved = (ancestors(torch.tensor(parents))[carriers] & ~there).mT  # [T, 33]
    reaches = torch.zeros(len(names), len(carriers), dtype=torch.bool)
    for i, number in zip(entry_turn, entry_number, strict=True):
        reaches[number] |= moved[i]

    return BodyRig(
        names=names,
        joint=joints,
        parent=torch.tensor(parents),
        entry_turn=torch.tensor(entry_turn),
        entry_number=torch.tensor(entry_number),
        entry_axis=torch.stack(entry_axis),
        carrier=carriers,
        reaches=reaches,
        limbs=tuple(_limb(names, *item) for item in limbs.items()),
    )


def prior(rig: BodyRig) -> tuple[Tensor, Tensor]:
    """Precisions ``[D, D]`` of the numbers about rest, 0 for the root, and their minima ``[D]``."""
    sigma = [torch.inf] * 6
    minimum = [-torch.inf] * 6
    for name in rig.names[6:]:
        key = name.removeprefix("left_").removeprefix("right_")
        minimum.append(HINGE_MINIMA.get(key, -torch.inf))
        if name in TRUNK:
            sigma.append(torch.inf)
        elif key in NUMBER_SIGMAS:
            sigma.append(NUMBER_SIGMAS[key])
        else:
            role, _, _ = key.partition("_")
            sigma.append(NUMBER_SIGMAS[role])
    precision = torch.tensor(sigma).square().reciprocal().diag()

    # Numbers of the trunk depend on each other.
    trunk = torch.tensor([rig.names.index(name) for name in TRUNK])
    precision[trunk[:, None], trunk] = trunk_covariance().inverse().float()
    return precision, torch.tensor(minimum)


@lru_cache(maxsize=1)
def trunk_covariance() -> Tensor:
    """``[13, 13]`` square radians, float64: of `TRUNK`, learnt by scripts/learn_trunk.py.

    It says how the bends of spine and collarbones go together, which landmarks of hips and
    shoulders leave open: each pair shows neither the pitch of the pelvis nor that of the chest.

    Source: motions of the CMU Graphics Lab Motion Capture Database; see ATTRIBUTION.md.
    """
    path = Path(__file__).with_name("assets") / "trunk.json"
    values = json.loads(path.read_text())
    return torch.tensor(values["covariance"], dtype=torch.float64)


def _limb(names: tuple[str, ...], words: str, axes: LimbAxes) -> Limb:
    """A limb of its side, name and joints, as in ``left arm shoulder elbow wrist``."""
    # The angle between the bones at rest, from which the hinge is counted.
    side, limb, first, middle, end = words.split()
    bend = torch.atan2(
        torch.linalg.cross(axes.upper, axes.lower).norm(),
        axes.upper @ axes.lower,
    )

    # The swing turns about two axes across the upper bone.
    across = torch.linalg.cross(axes.upper, axes.flat)
    return Limb(
        hub=CHEST if limb == "arm" else PELVIS,
        points=(
            MEDIAPIPE33.names.index(f"{side}_{first}"),
            MEDIAPIPE33.names.index(f"{side}_{middle}"),
            MEDIAPIPE33.names.index(f"{side}_{end}"),
        ),
        numbers=(
            names.index(f"{side}_{limb}_a"),
            names.index(f"{side}_{limb}_b"),
            names.index(f"{side}_{limb}_twist"),
            names.index(f"{side}_{middle}"),
        ),
        axes=torch.stack([axes.flat, across, axes.upper]),
        bend=float(bend),
    )


def ancestors(parent: Tensor) -> Tensor:
    """``[T, T]`` bool: whether the turn of a row follows that of a column, itself included."""
    # Parents come before their children.
    above = torch.eye(len(parent), dtype=torch.bool)
    for i, p in enumerate(parent.tolist()):
        if p >= 0:
            above[i] |= above[p]
    return above
