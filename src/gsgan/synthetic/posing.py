"""The choreography as poses of a character, by inverse kinematics on its own skeleton.

Convention: that of :mod:`gsgan.motion.rig`.
"""

from collections.abc import Sequence

import numpy as np

from gsgan.motion.character import Animation, Character
from gsgan.motion.rig import ARM, FINGERS, LEG, SIDES, SIGN, SPINE, Pose, Rig, frame
from gsgan.motion.rotations import Array, blend, rotation, unit
from gsgan.synthetic import controls
from gsgan.synthetic.choreography import EVERYDAY
from gsgan.synthetic.controls import (
    Controls,
    Programme,
    controls_at,
    passages_at,
    smoothstep,
)
from gsgan.synthetic.footsteps import Footsteps

X, Y, Z = np.eye(3)
# Flexion of a finger's joints at full curl, radians; the thumb's first joint turns in its saddle.
FLEXION = {"Thumb": (0.5, 0.6, 0.9)} | dict.fromkeys(FINGERS[1:], (1.4, 1.7, 1.1))
FAN = (0, 1.5, 0.5, -0.5, -1.5)  # a finger's place, in spreads towards the thumb
KNUCKLE = 0.1  # metres from the wrist, of hands without fingers
# the forearm's range, radians from mid-way
PRONATION = -1.3
SUPINATION = 1.3

Placed = tuple[Array, Array]  # a wrist's position [F, 3] and its hand's turn [F, 3, 3]


class Choreography:
    """A choreography on a character, at any times.

    Lengths follow the character's own arms and legs; what its rig does not have stays at rest.

    Args:
        character: the subject.
        seed: of amplitudes, phases, leading hands and blinks.
        programme: the passages.
    """

    def __init__(
        self, character: Character, seed: int = 0, programme: Programme = EVERYDAY
    ) -> None:
        self.rig = Rig(character)
        self.seed = seed
        self.programme = programme
        self.duration = programme.duration
        self.steps = Footsteps(seed, programme)

    def at(self, times: Array) -> Animation:
        """The poses at times ``[F]``, seconds in [0, `duration`]."""
        c = controls_at(times, self.seed, self.programme)
        feet = [self.steps.at(times, foot) for foot in range(2)]
        _follow_feet(c, feet)
        heading = rotation(c.path[:, 2:] * Z)
        scale = self.rig.leg / controls.LEG
        hips = self.rig.joint["Hips"] + scale * c.pelvis
        hips = scale * c.path * (1, 1, 0) + (heading @ hips[..., None])[..., 0]
        pose = Pose(self.rig, hips)
        pose.set_turn("Hips", heading @ rotation(c.lean))
        pose.bend(SPINE, c.spine)
        pose.bend(("Neck", "Head"), c.head)
        ankles = [
            self._foot(pose, side, *_freed(c, i, *feet[i][:3]))
            for i, side in enumerate(SIDES)
        ]
        pose.lower_hips(ankles)
        for i, side in enumerate(SIDES):
            middle = (c.path[:, 2:] + feet[i][0][:, 2:]) / 2
            pole = rotation(middle * Z) @ (0.1 * SIGN[side], -1.0, 0.0)
            freed = (heading @ (c.knee[:, i] * (SIGN[side], 1, 1))[..., None])[..., 0]
            pose.reach(side, LEG, ankles[i], pole + c.free[:, i, None] * (freed - pole))
            placed = (
                None
                if np.isnan(c.knuckle[:, i]).any()
                else self._placed(pose, c, i, side)
            )
            self._arm(pose, c, i, side, placed)
            self._hand(pose, c, i, side, placed)
        return pose.motion(self._face(c, times), passages_at(times, self.programme))

    def _foot(
        self,
        pose: Pose,
        side: str,
        place: Array,
        height: Array,
        pitch: Array,
        toes: Array,
    ) -> Array:
        """Turns a foot, its toes flat while they stand; returns the ankle's position ``[F, 3]``."""
        joint = self.rig.joint
        scale = self.rig.leg / controls.LEG
        ankle = joint[side + "Foot"]
        toe = joint.get(side + "ToeBase", ankle + scale * np.array([0, -0.14, -0.06]))
        heading = rotation(place[:, 2:] * Z)
        tilt = heading @ rotation(pitch[:, None] * X)
        pose.set_turn(side + "Foot", tilt)
        off = pitch * np.maximum(0.5 * smoothstep(height / 0.05), toes)
        pose.set_turn(side + "ToeBase", heading @ rotation(off[:, None] * X))
        stand = scale * np.column_stack([place[:, :2], height])
        return stand + heading @ (toe * (0, 1, 1)) + tilt @ ((ankle - toe) * (0, 1, 1))

    def _placed(self, pose: Pose, c: Controls, i: int, side: str) -> Placed:
        """Where the wrist has to be for the knuckle to be at its place, and the hand's turn."""
        joint = self.rig.joint
        chest = self.rig.chest
        sign = SIGN[side]
        scale = self.rig.arm / controls.ARM
        mirror = np.array([sign, 1, 1])
        turn = pose.turn(chest) @ _hand_turn(c, i, side)
        middle = (joint["LeftArm"] + joint["RightArm"]) / 2
        origin = pose.position(chest) + pose.rotation(chest) @ (middle - joint[chest])
        place = scale * mirror * c.knuckle[:, i]
        knuckle = origin + (pose.turn(chest) @ place[..., None])[..., 0]
        length = scale * KNUCKLE * sign * X
        if side + "HandMiddle1" in joint:
            length = joint[side + "HandMiddle1"] - joint[side + "Hand"]
            length = self.rig.turns[side + "Hand"].T @ length
        return knuckle - turn @ length, turn

    def _gripping(self, c: Controls, i: int, side: str) -> Placed:
        """Where `Controls.grip` places the wrist, and the hand's turn."""
        scale = self.rig.leg / controls.LEG
        mirror = np.array([SIGN[side], 1, 1])
        heading = rotation(c.path[:, 2:] * Z)
        wrist = (
            c.path * (1, 1, 0) + (heading @ (c.grip[:, i] * mirror)[..., None])[..., 0]
        )
        return scale * wrist, heading @ _hand_turn(c, i, side)

    def _arm(
        self, pose: Pose, c: Controls, i: int, side: str, placed: Placed | None = None
    ) -> None:
        """Turns collarbone, upper arm and forearm so that the wrist comes to its target."""
        scale = self.rig.arm / controls.ARM
        mirror = np.array([SIGN[side], 1, 1])
        chest = pose.turn(self.rig.chest)
        wrist = c.wrist[:, i]
        if placed is not None:
            away = (placed[0] - pose.position(side + "Arm")) / scale
            wrist = (np.swapaxes(chest, -1, -2) @ away[..., None])[..., 0] * mirror
        hold = c.hold[:, i, None]
        grip = self._gripping(c, i, side)[0]
        away = (grip - pose.position(side + "Arm")) / scale
        held = (np.swapaxes(chest, -1, -2) @ away[..., None])[..., 0] * mirror
        wrist = wrist + hold * (held - wrist)
        lift = 0.4 * smoothstep((wrist[:, 2] + 0.15) / 0.6) - 0.05
        forth = 0.25 * smoothstep((-wrist[:, 1] - 0.2) / 0.3)
        raised = np.stack([0 * lift, -lift * SIGN[side], -forth * SIGN[side]], axis=1)
        collar = side + "Shoulder"
        if collar in self.rig.index:
            pose.bend((collar,), raised)
        target = (
            pose.position(side + "Arm")
            + scale * (chest @ (wrist * mirror)[..., None])[..., 0]
        )
        target = target + hold * (grip - target) if placed is None else placed[0]
        pose.reach(
            side, ARM, target, (chest @ (c.elbow[:, i] * mirror)[..., None])[..., 0]
        )

    def _hand(
        self, pose: Pose, c: Controls, i: int, side: str, placed: Placed | None = None
    ) -> None:
        """Turns the hand on the forearm, and bends the fingers."""
        roll = c.palm[:, i].clip(PRONATION, SUPINATION)[:, None]
        bend = rotation(-roll * X) @ rotation(c.flex[:, i, None] * SIGN[side] * Y)
        turn = pose.turn(side + "ForeArm") @ bend if placed is None else placed[1]
        pose.set_hand(
            side, blend(turn, self._gripping(c, i, side)[1], c.hold[:, i, None])
        )
        thumbwards = -SIGN[side] * self.rig.turns[side + "Hand"][:, 2]
        for bone, finger, joint, hinge, straight, across in self.rig.fingers[side]:
            k = FINGERS.index(finger)
            curl = c.curl[:, i, k, None]
            base = float(joint == 0)
            aside = base * FAN[k] * c.spread[:, i, None] * thumbwards
            flexed = (
                FLEXION[finger][joint] * (curl + base * c.bend[:, i, k, None])
                - straight
            )
            turn = rotation(flexed * hinge + curl * across + aside)
            pose.world[bone] = pose.rotation(pose.parent(bone)) @ turn

    def _face(self, c: Controls, times: Array) -> dict[str, Array]:
        shapes = blinks(times, self.duration, self.seed)
        mouth = c.mouth.clip(0, 1)
        vowel = 0.5 + 0.5 * np.sin(9 * times)
        shapes |= {
            "mouth_open": 0.7 * mouth,
            "mouth_round": 0.5 * mouth * vowel + c.round,
        }
        shapes["mouth_wide"] = 0.5 * mouth * (1 - vowel) + c.wide
        for side in ("left", "right"):
            shapes[f"smile_{side}"] = 0.8 * c.smile.clip(0, 1)
            shapes[f"brow_up_{side}"] = c.brows.clip(0, 1)
            shapes[f"brow_down_{side}"] = (-c.brows).clip(0, 1)
        return shapes


def _hand_turn(c: Controls, i: int, side: str) -> Array:
    """``[F, 3, 3]`` the hand's turn in the axes of its `pointing` and `facing`."""
    mirror = np.array([SIGN[side], 1, 1])
    along = unit(c.pointing[:, i] * mirror)
    palm = c.facing[:, i] * mirror
    palm = unit(palm - (palm * along).sum(-1, keepdims=True) * along)
    return frame(along, palm) @ frame(SIGN[side] * X, -Z).T


def _freed(
    c: Controls, i: int, place: Array, height: Array, pitch: Array
) -> tuple[Array, ...]:
    """A foot's place, height, pitch and toes: of its steps, or, as far as it is free, its own."""
    x, y, out, *rest = c.step[:, i].T
    sign = 1 - 2 * i
    heading = c.path[:, 2]
    cosine = np.cos(heading)
    sine = np.sin(heading)
    x, y = (
        c.path[:, 0] + cosine * sign * x - sine * y,
        c.path[:, 1] + sine * sign * x + cosine * y,
    )
    own = np.column_stack([x, y, heading + sign * out, *rest])
    stepped = np.column_stack([place, height, pitch, 0 * pitch])
    found = stepped + c.free[:, i, None] * (own - stepped)
    return found[:, :3], *found[:, 3:].T


def blinks(times: Array, duration: float, seed: int) -> dict[str, Array]:
    """Weights of the face shapes of both eyes at times ``[F]``: a blink every three seconds."""
    random = np.random.default_rng([seed, 1])
    moments = np.cumsum(random.uniform(1.5, 4.5, int(duration / 1.5) + 1))
    closed = np.exp(-(((times[:, None] - moments) / 0.08) ** 2)).sum(axis=1).clip(0, 1)
    return {"blink_left": closed, "blink_right": closed}


def _follow_feet(c: Controls, feet: Sequence[tuple[Array, ...]]) -> None:
    """Shifts the body's weight to the standing foot, and swings the arms with the legs."""
    (left, *_, left_load), (right, *_, right_load) = feet
    c.pelvis[:, 0] += 0.03 * (right_load - left_load)
    forward = np.stack([np.sin(c.path[:, 2]), -np.cos(c.path[:, 2])], axis=1)
    # metres, of the left foot
    ahead = c.swing * ((left - right)[:, :2] * forward).sum(axis=1)
    c.wrist[:, 0, 1] += ahead
    c.wrist[:, 1, 1] -= ahead
    c.wrist[:, :, 2] += 0.03 * c.swing[:, None]
    c.spine[:, 2] += 0.3 * ahead
