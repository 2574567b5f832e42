"""Poses of any humanoid rig: world rotations since a standard pose, inverse kinematics, contact.

Convention: metres, Z up. The standard pose is an upright T: it faces -Y, its left arm points to +X,
palms down, legs straight down. A *turn* is a bone's world rotation since that pose: rigs whose rest
poses differ share turns. Pairs are left, right; "mirrored" vectors have x pointing away from the
middle of the body on both sides.
"""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from gsgan.motion.character import Animation, Character
from gsgan.motion.rotations import Array, between, rotation, twist, unit

SIDES = ("Left", "Right")
FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")
SIGN = {"Left": 1.0, "Right": -1.0}
SPINE = ("Spine", "Spine1", "Spine2")
ARM = ("Arm", "ForeArm", "Hand")
LEG = ("UpLeg", "Leg", "Foot")
REQUIRED = ("Hips", *(side + bone for side in SIDES for bone in LEG + ARM))
# the forearm's share of the hand's twist: without twist bones, half each
FOREARM_TWIST = 0.55
# sine of the angle of legs apart from which feet may be tilted with them
SPLAYED = 0.17
# longest reach of a limb in full lengths: below 1, so that it always bends
REACH = 0.998
# metres above the floor up to which a vertex of the resting foot is its sole
SOLE = 0.02


def limb_axes(part: tuple[str, ...], side: str) -> tuple[Array, Array]:
    """Direction of a limb in the standard pose, and the axis about which its hinge flexes."""
    if part == LEG:
        return np.array([0.0, 0, -1]), np.array([1.0, 0, 0])
    return np.array([SIGN[side], 0, 0]), np.array([0, 0, -SIGN[side]])


def hand_axes(joint: Mapping[str, Array], side: str) -> Array:
    """``[3, 3]`` columns: along the hand, towards the little finger, and their cross product."""
    base = {
        finger: joint[f"{side}Hand{finger}1"] for finger in ("Index", "Middle", "Pinky")
    }
    along = unit(base["Middle"] - joint[side + "Hand"])
    across = base["Pinky"] - base["Index"]
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
        shin = unit(joint[side + "Foot"] - joint[side + "Leg"])
        toe = unit(
            joint.get(side + "ToeBase", joint[side + "Foot"]) - joint[side + "Foot"]
        )
        tilt = between(np.array([0.0, 0, -1]), shin * (1, 0, 1))
        if abs(shin[0]) > SPLAYED and abs(tilt[:, 0] @ toe) < abs(toe[0]):
            turns[side + "Foot"] = turns[side + "ToeBase"] = tilt
        for part in (LEG, ARM):
            first, middle, end = (joint[side + bone] for bone in part)
            upper = between(limb_axes(part, side)[0], middle - first)
            turns[side + part[0]] = upper
            turns[side + part[1]] = between(middle - first, end - middle) @ upper
        turns[side + "Hand"] = hand = turns[side + "ForeArm"]
        if {
            f"{side}Hand{finger}1" for finger in ("Index", "Middle", "Pinky")
        } <= joint.keys():
            standard = np.diag([SIGN[side], 1.0, SIGN[side]])
            turns[side + "Hand"] = hand = hand_axes(joint, side) @ standard
        for finger in FINGERS:
            for bone, following in phalanges(joint, side, finger):
                here = joint[following] - joint[bone]
                turns[bone] = between(hand[:, 0] * SIGN[side], here) @ hand
    return turns


def phalanges(
    joint: Mapping[str, Array], side: str, finger: str
) -> list[tuple[str, str]]:
    """A finger's bones that have a following joint, with the name of that joint."""
    names = [f"{side}Hand{finger}{k}" for k in (1, 2, 3, 4)]
    return [
        (bone, end) for bone, end in pairwise(names) if bone in joint and end in joint
    ]


def finger_hinges(
    joint: Mapping[str, Array], turns: Mapping[str, Array], side: str
) -> list[tuple[str, str, int, Array, float, Array]]:
    """A hand's finger bones, bases first, with the axes about which they bend.

    Returns:
        Per bone: its name, finger, number from the base; the axis ``[3]`` of flexion at rest; the
        rest pose's flexion (radians); the axis-angle ``[3]`` that closes the gap to the middle
        finger, zero but for bases.
    """
    rows: list[tuple[str, str, int, Array, float, Array]] = []
    if side + "HandPinky1" not in joint or side + "HandMiddle1" not in joint:
        return rows
    hand = turns[side + "Hand"]
    along = hand[:, 0] * SIGN[side]
    palm = -hand[:, 2]
    # to which the thumb's tip bends
    opposite = joint[side + "HandPinky1"] + 0.03 * palm
    for finger in FINGERS:
        before = along
        for k, (bone, end) in enumerate(phalanges(joint, side, finger)[:3]):
            here = unit(joint[end] - joint[bone])
            aim = unit(opposite - joint[bone]) if finger == "Thumb" else palm
            hinge = unit(np.cross(here, aim))
            if finger == "Thumb":
                straight = 0.0
                across = np.zeros(3)
            else:
                straight = float(
                    np.arctan2(np.cross(before, here) @ hinge, before @ here)
                )
                gap = float(np.arcsin(np.cross(here, along) @ palm))
                across = 0.8 * gap * palm * (k == 0)
            rows.append((bone, finger, k, hinge, straight, across))
            before = here
    return rows


class Rig:
    """The properties of a character that posing uses: bones, limb lengths, rest turns and soles."""

    def __init__(self, character: Character) -> None:
        self.character = character
        self.index = {name: j for j, name in enumerate(character.bones)}
        self.joint = {name: character.joints[j] for name, j in self.index.items()}
        self.turns = rest_turns(self.joint)
        self.leg, self.arm = (
            sum(
                self.length("Left" + a, "Left" + b)
                for a, b in ((p[0], p[1]), (p[1], p[2]))
            )
            for p in (LEG, ARM)
        )
        self.chest = max(
            (b for b in ("Hips", *SPINE) if b in self.index), key=self.index.__getitem__
        )
        self.fingers = {
            side: finger_hinges(self.joint, self.turns, side) for side in SIDES
        }
        main = character.dominant_bones()
        self.soles: dict[str, Array] = {}
        for side in SIDES:
            parts = [
                character.with_descendants(self.index[bone])
                if bone in self.index
                else []
                for bone in (side + "Foot", side + "ToeBase")
            ]
            parts[0] = [j for j in parts[0] if j not in parts[1]]
            for bone, part in zip(
                (side + "Foot", side + "ToeBase"), parts, strict=True
            ):
                of_bone = np.isin(main, part)
                points = character.vertices[of_bone & (character.vertices[:, 2] < SOLE)]
                self.soles[bone] = points[:: max(1, len(points) // 300)]

    def length(self, start: str, end: str) -> float:
        """Distance between two joints of the rest pose, metres."""
        return float(np.linalg.norm(self.joint[end] - self.joint[start]))


class Pose:
    """Poses at F moments under construction; bones that are not set follow their parents."""

    def __init__(self, rig: Rig, hips: Array) -> None:
        # [F, 3] position of the Hips joint
        self.rig = rig
        self.hips = hips
        # bone → [F, 3, 3] world rotation since the rest pose
        self.world: dict[str, Array] = {}

    def set_turn(self, bone: str, turn: Array) -> None:
        """Sets a bone by its turn ``[F, 3, 3]``, where the character has this bone."""
        if bone in self.rig.index:
            self.world[bone] = turn @ self.rig.turns.get(bone, np.eye(3)).T

    def bend(self, bones: tuple[str, ...], axis_angle: Array) -> None:
        """Distributes an axis-angle ``[F, 3]``, in standard axes, over a chain of bones."""
        bones = tuple(bone for bone in bones if bone in self.rig.index)
        for bone in bones:
            self.set_turn(
                bone, self.turn(self.parent(bone)) @ rotation(axis_angle / len(bones))
            )

    def turn(self, bone: str) -> Array:
        """A bone's turn ``[F, 3, 3]``."""
        return self.rotation(bone) @ self.rig.turns.get(bone, np.eye(3))

    def rotation(self, bone: str) -> Array:
        """A bone's world rotation ``[F, 3, 3]`` since the rest pose."""
        while bone not in self.world:
            top = self.rig.character.parents[self.rig.index[bone]] < 0
            bone = "Hips" if top else self.parent(bone)
        return self.world[bone]

    def parent(self, bone: str) -> str:
        character = self.rig.character
        return character.bones[character.parents[self.rig.index[bone]]]

    def position(self, bone: str) -> Array:
        """A joint's position ``[F, 3]``, metres; what is not below the hips moves with them."""
        if bone == "Hips":
            return self.hips
        top = self.rig.character.parents[self.rig.index[bone]] < 0
        parent = "Hips" if top else self.parent(bone)
        offset = self.rig.joint[bone] - self.rig.joint[parent]
        return self.position(parent) + self.rotation(parent) @ offset

    def reach(
        self, side: str, part: tuple[str, str, str], target: Array, pole: Array
    ) -> None:
        """Turns a limb so that its end comes to ``target``, the middle bent towards ``pole``.

        Args:
            side: "Left" or "Right".
            part: `ARM` or `LEG`.
            target: ``[F, 3]`` metres; where it is out of reach, the limb points to it.
            pole: ``[F, 3]`` direction.
        """
        first, middle, end = (side + bone for bone in part)
        upper, lower, hinge = two_bone(
            target - self.position(first),
            pole,
            self.rig.length(first, middle),
            self.rig.length(middle, end),
        )
        along, axis = limb_axes(part, side)
        rest = frame(along, axis).T
        self.set_turn(first, frame(upper, hinge) @ rest)
        self.set_turn(middle, frame(lower, hinge) @ rest)

    def lower_hips(self, ankles: list[Array]) -> None:
        """Lowers the hips to where both legs reach their ankles ``[F, 3]``."""
        longest = 0.995 * REACH * self.rig.leg
        drop = np.zeros(len(self.hips))
        for side, ankle in zip(SIDES, ankles, strict=True):
            gap = self.position(side + "UpLeg") - ankle
            flat = (gap[:, :2] ** 2).sum(axis=1)
            drop = np.maximum(
                drop, gap[:, 2] - np.sqrt(np.maximum(longest**2 - flat, 0))
            )
        self.hips = self.hips - drop[:, None] * (0, 0, 1)

    def set_hand(self, side: str, turn: Array) -> None:
        """Sets a hand's turn ``[F, 3, 3]``; the forearm takes a share of its twist."""
        upper = self.turn(side + "Arm")
        lower = self.turn(side + "ForeArm")
        neutral = between(upper[..., 0], lower[..., 0]) @ upper
        angle = FOREARM_TWIST * twist(np.swapaxes(neutral, -1, -2) @ turn, axis=0)
        self.set_turn(
            side + "ForeArm", neutral @ rotation(angle[:, None] * np.eye(3)[0])
        )
        self.set_turn(side + "Hand", turn)

    def lowest(self, side: str) -> Array:
        """``[F]`` height of the lowest point of a sole, metres."""
        heights = [np.full(len(self.hips), np.inf)]
        for bone in (side + "Foot", side + "ToeBase"):
            points = self.rig.soles[bone]
            if len(points):
                up = self.rotation(bone)[:, 2] @ (points - self.rig.joint[bone]).T
                heights.append(self.position(bone)[:, 2] + up.min(axis=-1))
        return np.min(heights, axis=0)

    def motion(
        self, shapes: Mapping[str, Array], passages: tuple[str, ...]
    ) -> Animation:
        """The finished poses, with the face shapes that the character has."""
        character = self.rig.character
        rotations = np.stack([self.rotation(bone) for bone in character.bones], axis=1)
        joints = np.stack([self.position(bone) for bone in character.bones], axis=1)
        known = {
            name: weight for name, weight in shapes.items() if name in character.shapes
        }
        return Animation(rotations, joints, known, passages)


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
    nearest = abs(upper - lower) + 0.05 * min(upper, lower)
    d = np.linalg.norm(target, axis=-1, keepdims=True).clip(
        nearest, REACH * (upper + lower)
    )
    along = unit(target)
    side = unit(pole - (pole * along).sum(-1, keepdims=True) * along)
    cosine = (upper**2 + d**2 - lower**2) / (2 * upper * d)
    middle = upper * (cosine * along + np.sqrt(np.maximum(1 - cosine**2, 0)) * side)
    return unit(middle), unit(d * along - middle), np.cross(side, along)


def frame(along: Array, normal: Array) -> Array:
    """Rotations whose columns are a direction, a normal to it, and their cross product."""
    return np.stack([along, normal, np.cross(along, normal)], axis=-1)
