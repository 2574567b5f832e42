"""Poses of any humanoid rig: world rotations since a standard pose, inverse kinematics, contact.

Units are metres, Z points up. The standard pose is an upright T: it faces -Y, its left arm points
to +X, palms down, legs straight down. A *turn* is a bone's world rotation since that pose: rigs
whose rest poses differ share turns. Pairs are left, right; "mirrored" vectors have x pointing away
from the middle of the body on both sides.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from gsgan.motion.character import Animation, Character
from gsgan.motion.rotations import Array, between, rotation, twist, unit

SIDES = ("Left", "Right")
FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")
# The side's direction along +X.
SIGN = {"Left": 1.0, "Right": -1.0}
# Chains of bones, from the hips outwards.
SPINE = ("Spine", "Spine1", "Spine2")
PALM_FINGERS = (
    "Index",
    "Middle",
    "Pinky",
)  # fingers whose bases give the hand's axes
ARM = ("Arm", "ForeArm", "Hand")
LEG = ("UpLeg", "Leg", "Foot")
REQUIRED = ("Hips", *(side + bone for side in SIDES for bone in LEG + ARM))
# The forearm takes this share of the hand's twist: without twist bones, about half.
FOREARM_TWIST = 0.55
# Feet may be tilted with legs that stand apart by more than the angle with this sine.
SPLAYED = 0.17
# Maximum reach of a limb in full lengths: below 1, so that it always bends.
MAX_LIMB_REACH = 0.998
# Metres above the floor up to which a vertex of the resting foot is its sole.
SOLE_HEIGHT = 0.02


def limb_axes(part: tuple[str, ...], side: str) -> tuple[Array, Array]:
    """Direction of a limb in the standard pose, and the axis about which its hinge flexes."""
    if part == LEG:
        return np.array([0.0, 0, -1]), np.array([1.0, 0, 0])
    return np.array([SIGN[side], 0, 0]), np.array([0, 0, -SIGN[side]])


def hand_axes(joint: Mapping[str, Array], side: str) -> Array:
    """``[3, 3]`` columns: along the hand, towards the little finger, and their cross product."""
    index = joint[side + "HandIndex1"]
    middle = joint[side + "HandMiddle1"]
    pinky = joint[side + "HandPinky1"]
    along = unit(middle - joint[side + "Hand"])

    # The part of the line between the knuckles that is orthogonal to the first axis.
    across = pinky - index
    across = unit(across - (across @ along) * along)
    return np.stack([along, across, np.cross(along, across)], axis=-1)


def rest_turns(joint: Mapping[str, Array]) -> dict[str, Array]:
    """Turns ``[3, 3]`` of a rest pose's limbs and fingers, from joint positions ``[3]`` by name.

    The other bones rest in the standard pose: where spines, collarbones and feet point differs
    between rigs more than between people. Feet at right angles to legs that stand apart, as CMU's,
    are tilted with them.
    """
    turns = {}
    for side in SIDES:
        # Feet are tilted with the legs if that makes their toes point less to the side.
        foot = joint[side + "Foot"]
        shin = unit(foot - joint[side + "Leg"])
        toe = unit(joint.get(side + "ToeBase", foot) - foot)
        tilt = between(np.array([0.0, 0, -1]), shin * (1, 0, 1))
        if abs(shin[0]) > SPLAYED and abs(tilt[:, 0] @ toe) < abs(toe[0]):
            turns[side + "Foot"] = tilt
            turns[side + "ToeBase"] = tilt

        # The upper bone of a limb turns by the smallest rotation, the lower one relative to it.
        for part in (LEG, ARM):
            first, middle, end = [joint[side + bone] for bone in part]
            along, _ = limb_axes(part, side)
            upper = between(along, middle - first)
            turns[side + part[0]] = upper
            turns[side + part[1]] = (
                between(middle - first, end - middle) @ upper
            )

        # The hand turns with its palm if that is known, else with the forearm.
        hand = turns[side + "ForeArm"]
        if all(f"{side}Hand{finger}1" in joint for finger in PALM_FINGERS):
            standard = np.diag([SIGN[side], 1.0, SIGN[side]])
            hand = hand_axes(joint, side) @ standard
        turns[side + "Hand"] = hand

        # Fingers turn from the hand's direction to their own; a bone without end has the direction
        # of the one before.
        for finger in FINGERS:
            for bone, following in phalanges(joint, side, finger):
                along = joint[following] - joint[bone]
                turns[bone] = between(hand[:, 0] * SIGN[side], along) @ hand
                turns[following] = turns[bone]
    return turns


def phalanges(
    joint: Mapping[str, Array], side: str, finger: str
) -> list[tuple[str, str]]:
    """A finger's bones that have a following joint, with the name of that joint."""
    names = [f"{side}Hand{finger}{k}" for k in (1, 2, 3, 4)]
    pairs = []
    for bone, following in pairwise(names):
        if bone in joint and following in joint:
            pairs.append((bone, following))
    return pairs


class FingerHinge(NamedTuple):
    """A finger bone and the axis about which it bends."""

    bone: str  # Mixamo's name
    finger: str  # one of `FINGERS`
    number: int  # from the finger's base
    axis: Array  # [3] of flexion at rest
    straight: float  # flexion of the rest pose, radians
    # [3] axis-angle that closes the gap to the middle finger; zero except for bases
    across: Array


def finger_hinges(
    joint: Mapping[str, Array], turns: Mapping[str, Array], side: str
) -> list[FingerHinge]:
    """The hinges of a hand's finger bones, bases first."""
    hinges: list[FingerHinge] = []
    if side + "HandPinky1" not in joint or side + "HandMiddle1" not in joint:
        return hinges
    hand = turns[side + "Hand"]
    forward = hand[:, 0] * SIGN[side]
    palm = -hand[:, 2]
    # The point to which the thumb's tip bends.
    opposite = joint[side + "HandPinky1"] + 0.03 * palm

    for finger in FINGERS:
        # Each phalanx is bent against the one before.
        before = forward
        for k, (bone, end) in enumerate(phalanges(joint, side, finger)[:3]):
            along = unit(joint[end] - joint[bone])
            straight = 0.0
            across = np.zeros(3)
            if finger == "Thumb":
                # The thumb bends towards the base of the little finger.
                axis = unit(np.cross(along, unit(opposite - joint[bone])))
            else:
                # Fingers bend towards the palm.
                axis = unit(np.cross(along, palm))
                sine = np.cross(before, along) @ axis
                straight = float(np.arctan2(sine, before @ along))
                # The base also closes most of the gap to the middle finger.
                gap = float(np.arcsin(np.cross(along, forward) @ palm))
                across = 0.8 * gap * palm * (k == 0)
            hinges.append(
                FingerHinge(
                    bone=bone,
                    finger=finger,
                    number=k,
                    axis=axis,
                    straight=straight,
                    across=across,
                )
            )
            before = along
    return hinges


class Rig:
    """The properties of a character that posing uses: bones, limb lengths, rest turns and soles."""

    def __init__(self, character: Character) -> None:
        self.character = character
        self.index = {}
        self.joint = {}
        for j, name in enumerate(character.bones):
            self.index[name] = j
            self.joint[name] = character.joints[j]
        self.turns = rest_turns(self.joint)

        # Motions scale with these lengths.
        self.leg = self._limb_length(LEG)
        self.arm = self._limb_length(ARM)

        # The last bone of the spine that there is.
        trunk = [bone for bone in ("Hips", *SPINE) if bone in self.index]
        self.chest = max(trunk, key=self.index.__getitem__)
        self.fingers = {}
        for side in SIDES:
            self.fingers[side] = finger_hinges(self.joint, self.turns, side)

        # The lower sides of foot and toes.
        self.soles: dict[str, Array] = {}
        for side in SIDES:
            toes = self._with_descendants(side + "ToeBase")
            foot = self._with_descendants(side + "Foot")
            self.soles[side + "Foot"] = self._sole(set(foot) - set(toes))
            self.soles[side + "ToeBase"] = self._sole(set(toes))

    def _limb_length(self, part: tuple[str, ...]) -> float:
        """Length of both bones of a left limb, metres."""
        first, middle, end = ["Left" + bone for bone in part]
        return self.length(first, middle) + self.length(middle, end)

    def _with_descendants(self, bone: str) -> list[int]:
        """Numbers of a bone and of all below it, none if the character does not have it."""
        if bone not in self.index:
            return []
        return self.character.with_descendants(self.index[bone])

    def _sole(self, bones: set[int]) -> Array:
        """Vertices ``[n, 3]`` near the floor that follow these bones most, about 300 of them."""
        character = self.character
        of_bones = np.isin(character.dominant_bones(), list(bones))
        is_low = character.vertices[:, 2] < SOLE_HEIGHT
        points = character.vertices[of_bones & is_low]
        return points[:: max(1, len(points) // 300)]

    def length(self, start: str, end: str) -> float:
        """Distance between two joints of the rest pose, metres."""
        return float(np.linalg.norm(self.joint[end] - self.joint[start]))


class Pose:
    """Poses at F moments under construction; bones that are not set follow their parents."""

    def __init__(self, rig: Rig, hips: Array) -> None:
        self.rig = rig
        self.hips = hips  # [F, 3] position of the Hips joint
        # bone → [F, 3, 3] world rotation since the rest pose
        self.world: dict[str, Array] = {}

    def set_turn(self, bone: str, turn: Array) -> None:
        """Sets a bone by its turn ``[F, 3, 3]``, if the character has this bone."""
        if bone in self.rig.index:
            rest = self.rig.turns.get(bone, np.eye(3))
            self.world[bone] = turn @ rest.T

    def bend(self, bones: tuple[str, ...], axis_angle: Array) -> None:
        """Distributes an axis-angle ``[F, 3]``, in standard axes, over a chain of bones."""
        bones = tuple(bone for bone in bones if bone in self.rig.index)
        for bone in bones:
            parent = self.turn(self.parent(bone))
            self.set_turn(bone, parent @ rotation(axis_angle / len(bones)))

    def turn(self, bone: str) -> Array:
        """A bone's turn ``[F, 3, 3]``."""
        return self.rotation(bone) @ self.rig.turns.get(bone, np.eye(3))

    def rotation(self, bone: str) -> Array:
        """A bone's world rotation ``[F, 3, 3]`` since the rest pose."""
        while bone not in self.world:
            bone = self.parent_or_hips(bone)
        return self.world[bone]

    def parent(self, bone: str) -> str:
        """The name of a bone's parent."""
        character = self.rig.character
        return character.bones[character.parents[self.rig.index[bone]]]

    def parent_or_hips(self, bone: str) -> str:
        """The name of a bone's parent, or the hips for a root."""
        is_root = self.rig.character.parents[self.rig.index[bone]] < 0
        return "Hips" if is_root else self.parent(bone)

    def position(self, bone: str) -> Array:
        """A joint's position ``[F, 3]`` in metres; joints not below the hips move with them."""
        if bone == "Hips":
            return self.hips
        parent = self.parent_or_hips(bone)
        offset = self.rig.joint[bone] - self.rig.joint[parent]
        return self.position(parent) + self.rotation(parent) @ offset

    def reach(
        self, side: str, part: tuple[str, str, str], target: Array, pole: Array
    ) -> None:
        """Turns a limb so that its end comes to ``target``, the middle bent towards ``pole``.

        Args:
            side: "Left" or "Right".
            part: `ARM` or `LEG`.
            target: ``[F, 3]`` metres; if it is out of reach, the limb points to it.
            pole: ``[F, 3]`` direction.
        """
        first, middle, end = [side + bone for bone in part]

        # The directions of both bones in the world.
        upper, lower, hinge = two_bone(
            target=target - self.position(first),
            pole=pole,
            upper=self.rig.length(first, middle),
            lower=self.rig.length(middle, end),
        )

        # Their turns, from the same axes in the standard pose.
        along, axis = limb_axes(part, side)
        rest = frame(along, axis).T
        self.set_turn(first, frame(upper, hinge) @ rest)
        self.set_turn(middle, frame(lower, hinge) @ rest)

    def lower_hips(self, ankles: list[Array]) -> None:
        """Lowers the hips to where both legs reach their ankles ``[F, 3]``."""
        longest = 0.995 * MAX_LIMB_REACH * self.rig.leg
        drop = np.zeros(len(self.hips))
        for side, ankle in zip(SIDES, ankles, strict=True):
            # By Pythagoras, the height of the hip joint at which the leg is fully stretched.
            gap = self.position(side + "UpLeg") - ankle
            horizontal = (gap[:, :2] ** 2).sum(axis=1)
            vertical = np.sqrt(np.maximum(longest**2 - horizontal, 0))
            drop = np.maximum(drop, gap[:, 2] - vertical)
        self.hips = self.hips - drop[:, None] * (0, 0, 1)

    def set_hand(self, side: str, turn: Array) -> None:
        """Sets a hand's turn ``[F, 3, 3]``; the forearm takes a share of its twist."""
        upper = self.turn(side + "Arm")
        lower = self.turn(side + "ForeArm")

        # The forearm without twist, and the hand's twist against it.
        neutral = between(upper[..., 0], lower[..., 0]) @ upper
        angle = FOREARM_TWIST * twist(neutral.mT @ turn, axis=0)
        x_axis = np.eye(3)[0]
        self.set_turn(
            side + "ForeArm", neutral @ rotation(angle[:, None] * x_axis)
        )
        self.set_turn(side + "Hand", turn)

    def lowest(self, side: str) -> Array:
        """``[F]`` height of the lowest point of a sole, metres."""
        heights = [np.full(len(self.hips), np.inf)]
        for bone in (side + "Foot", side + "ToeBase"):
            points = self.rig.soles[bone]
            if len(points):
                up = (
                    self.rotation(bone)[:, 2]
                    @ (points - self.rig.joint[bone]).T
                )
                heights.append(self.position(bone)[:, 2] + up.min(axis=-1))
        return np.min(heights, axis=0)

    def motion(
        self, shapes: Mapping[str, Array], passages: tuple[str, ...]
    ) -> Animation:
        """The finished poses, with the face shapes that the character has."""
        character = self.rig.character
        rotations = [self.rotation(bone) for bone in character.bones]
        joints = [self.position(bone) for bone in character.bones]
        face_shapes = {}
        for name, weight in shapes.items():
            if name in character.shapes:
                face_shapes[name] = weight
        return Animation(
            rotations=np.stack(rotations, axis=1),
            joints=np.stack(joints, axis=1),
            shapes=face_shapes,
            passages=passages,
        )


def two_bone(
    target: Array, pole: Array, upper: float, lower: float
) -> tuple[Array, Array, Array]:
    """Directions of two bones from the origin to a target, and their hinge; the law of cosines.

    Args:
        target: ``[F, 3]`` metres from the first joint.
        pole: ``[F, 3]`` direction in which the middle joint bends.
        upper, lower: lengths of the bones, metres.

    Returns:
        Unit vectors ``[F, 3]``: upper bone, lower bone, the axis that flexes the lower one.
    """
    # The distance d of the target, within reach.
    nearest = abs(upper - lower) + 0.05 * min(upper, lower)
    farthest = MAX_LIMB_REACH * (upper + lower)
    d = np.linalg.norm(target, axis=-1, keepdims=True).clip(nearest, farthest)

    # The way to the target, and the direction beside it in which the middle joint bends.
    along = unit(target)
    pole_along = (pole * along).sum(-1, keepdims=True) * along
    side = unit(pole - pole_along)

    # With the angle between the upper bone and the way, lower² = upper² + d² - 2 upper d cosine.
    cosine = (upper**2 + d**2 - lower**2) / (2 * upper * d)
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    middle = upper * (cosine * along + sine * side)
    return unit(middle), unit(d * along - middle), np.cross(side, along)


def frame(along: Array, normal: Array) -> Array:
    """Rotations whose columns are a direction, a normal to it, and their cross product."""
    return np.stack([along, normal, np.cross(along, normal)], axis=-1)
