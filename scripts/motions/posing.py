"""The choreography as poses of a character, by inverse kinematics on its own skeleton.

Units and axes are those of :mod:`gsgan.motion.rig`. Targets are given in lengths of a standard
person and are scaled to the character's own arms and legs.
"""

from typing import NamedTuple

import numpy as np
from motions import controls
from motions.choreography import EVERYDAY
from motions.controls import (
    Controls,
    Programme,
    controls_at,
    passages_at,
    smoothstep,
)
from motions.footsteps import FootState, Footsteps

from gsgan.motion.character import Animation, Character
from gsgan.motion.rig import (
    ARM,
    FINGERS,
    LEG,
    SIDES,
    SIGN,
    SPINE,
    Pose,
    Rig,
    frame,
)
from gsgan.motion.rotations import Array, blend, matvec, rotation, unit

X, Y, Z = np.eye(3)
# Flexion of a finger's joints at full curl, radians; the thumb's first joint turns in its saddle.
FLEXION = {"Thumb": (0.5, 0.6, 0.9)} | dict.fromkeys(
    FINGERS[1:], (1.4, 1.7, 1.1)
)
FINGER_FAN = (
    0,
    1.5,
    0.5,
    -0.5,
    -1.5,
)  # a finger's place, in spreads towards the thumb
KNUCKLE = 0.1  # metres from the wrist, of hands without fingers
# The forearm's range, radians from mid-way.
PRONATION = -1.3
SUPINATION = 1.3


class PlacedHand(NamedTuple):
    """A target for a hand, in world axes."""

    wrist: Array  # [F, 3] metres
    turn: Array  # [F, 3, 3] rotation of the hand


class Choreography:
    """A choreography on a character, at any times.

    Lengths follow the character's own arms and legs; what its rig does not have stays at rest.

    Args:
        character: the subject.
        seed: of amplitudes, phases and leading hands.
        programme: the passages.
    """

    def __init__(
        self,
        character: Character,
        seed: int = 0,
        programme: Programme = EVERYDAY,
    ) -> None:
        self.rig = Rig(character)
        self.seed = seed
        self.programme = programme
        self.duration = programme.duration
        self.steps = Footsteps(seed, programme)

    def at(self, times: Array) -> Animation:
        """The poses at times ``[F]``, seconds in [0, `duration`]."""
        # The passage's controls, with the feet in their steps.
        c = controls_at(times, self.seed, self.programme)
        feet = [self.steps.at(times, foot) for foot in range(2)]
        _follow_feet(c, feet)
        heading = rotation(c.path[:, 2:] * Z)

        # Hips, spine and head.
        scale = self.rig.leg / controls.LEG
        hips = self.rig.joint["Hips"] + scale * c.pelvis
        hips = scale * c.path * (1, 1, 0) + matvec(heading, hips)
        pose = Pose(self.rig, hips)
        pose.set_turn("Hips", heading @ rotation(c.lean))
        pose.bend(SPINE, c.spine)
        pose.bend(("Neck", "Head"), c.head)

        # Feet; the hips go down as far as the legs have to reach.
        ankles = []
        for i, side in enumerate(SIDES):
            ankles.append(self._foot(pose, side, _freed(c, i, feet[i])))
        pose.lower_hips(ankles)

        for i, side in enumerate(SIDES):
            # The knee points half-way between body and foot; a free leg has its own direction.
            middle = (c.path[:, 2:] + feet[i].place[:, 2:]) / 2
            pole = rotation(middle * Z) @ (0.1 * SIGN[side], -1.0, 0.0)
            freed = matvec(heading, c.knee[:, i] * (SIGN[side], 1, 1))
            pole = pole + c.free[:, i, None] * (freed - pole)
            pose.reach(side, LEG, ankles[i], pole)

            # A hand goes where its knuckles are placed, if the passage places them.
            placed = None
            if not np.isnan(c.knuckle[:, i]).any():
                placed = self._placed(pose, c, i, side)
            grip = self._gripping(c, i, side)
            self._arm(pose, c, i, side, grip, placed)
            self._hand(pose, c, i, side, grip, placed)
        return pose.motion(
            self._face(c, times), passages_at(times, self.programme)
        )

    def _foot(self, pose: Pose, side: str, foot: FootState) -> Array:
        """Turns a foot, its toes flat while they stand; returns the ankle's position ``[F, 3]``."""
        scale = self.rig.leg / controls.LEG
        ankle = self.rig.joint[side + "Foot"]
        usual_toe = ankle + scale * np.array([0, -0.14, -0.06])
        toe = self.rig.joint.get(side + "ToeBase", usual_toe)

        # The foot pitches about the ball; its toes do as far as it is lifted.
        heading = rotation(foot.place[:, 2:] * Z)
        tilt = heading @ rotation(foot.pitch[:, None] * X)
        pose.set_turn(side + "Foot", tilt)
        lifted = np.maximum(0.5 * smoothstep(foot.height / 0.05), foot.toes)
        toe_pitch = foot.pitch * lifted
        pose.set_turn(
            side + "ToeBase", heading @ rotation(toe_pitch[:, None] * X)
        )

        stand = scale * np.column_stack([foot.place[:, :2], foot.height])
        to_ball = heading @ (toe * (0, 1, 1))
        return stand + to_ball + tilt @ ((ankle - toe) * (0, 1, 1))

    def _placed(self, pose: Pose, c: Controls, i: int, side: str) -> PlacedHand:
        """Where the wrist has to be for the knuckle to be at its place, and the hand's turn."""
        joint = self.rig.joint
        chest = self.rig.chest
        scale = self.rig.arm / controls.ARM
        turn = pose.turn(chest) @ _hand_turn(c, i, side)

        # The knuckle's place, from the middle of the shoulders.
        middle = (joint["LeftArm"] + joint["RightArm"]) / 2
        origin = pose.position(chest) + pose.rotation(chest) @ (
            middle - joint[chest]
        )
        place = scale * np.array([SIGN[side], 1, 1]) * c.knuckle[:, i]
        knuckle = origin + matvec(pose.turn(chest), place)

        # The wrist is behind it by the length of the hand.
        length = scale * KNUCKLE * SIGN[side] * X
        if side + "HandMiddle1" in joint:
            length = joint[side + "HandMiddle1"] - joint[side + "Hand"]
            length = self.rig.turns[side + "Hand"].T @ length
        return PlacedHand(wrist=knuckle - turn @ length, turn=turn)

    def _gripping(self, c: Controls, i: int, side: str) -> PlacedHand:
        """Where `Controls.grip` places the wrist, and the hand's turn."""
        scale = self.rig.leg / controls.LEG
        heading = rotation(c.path[:, 2:] * Z)
        grip = matvec(heading, c.grip[:, i] * np.array([SIGN[side], 1, 1]))
        wrist = c.path * (1, 1, 0) + grip
        return PlacedHand(
            wrist=scale * wrist, turn=heading @ _hand_turn(c, i, side)
        )

    def _arm(
        self,
        pose: Pose,
        c: Controls,
        i: int,
        side: str,
        grip: PlacedHand,
        placed: PlacedHand | None,
    ) -> None:
        """Turns collarbone, upper arm and forearm so that the wrist comes to its target."""
        scale = self.rig.arm / controls.ARM
        mirror = np.array([SIGN[side], 1, 1])
        chest = pose.turn(self.rig.chest)
        to_chest = np.swapaxes(chest, -1, -2)
        shoulder = pose.position(side + "Arm")

        # The wrist in mirrored chest axes, from the shoulder.
        wrist = c.wrist[:, i]
        if placed is not None:
            wrist = matvec(to_chest, (placed.wrist - shoulder) / scale) * mirror
        hold = c.hold[:, i, None]
        held = matvec(to_chest, (grip.wrist - shoulder) / scale) * mirror
        wrist = wrist + hold * (held - wrist)

        # The collarbone rises and goes forwards with a wrist that is high or far in front.
        lift = 0.4 * smoothstep((wrist[:, 2] + 0.15) / 0.6) - 0.05
        forth = 0.25 * smoothstep((-wrist[:, 1] - 0.2) / 0.3)
        raised = np.stack(
            [0 * lift, -lift * SIGN[side], -forth * SIGN[side]], axis=1
        )
        if side + "Shoulder" in self.rig.index:
            pose.bend((side + "Shoulder",), raised)

        # The shoulder has moved with the collarbone.
        if placed is None:
            shoulder = pose.position(side + "Arm")
            target = shoulder + scale * matvec(chest, wrist * mirror)
            target = target + hold * (grip.wrist - target)
        else:
            target = placed.wrist
        elbow = matvec(chest, c.elbow[:, i] * mirror)
        pose.reach(side, ARM, target, elbow)

    def _hand(
        self,
        pose: Pose,
        c: Controls,
        i: int,
        side: str,
        grip: PlacedHand,
        placed: PlacedHand | None,
    ) -> None:
        """Turns the hand on the forearm, and bends the fingers."""
        if placed is None:
            roll = c.palm[:, i].clip(PRONATION, SUPINATION)[:, None]
            flex = c.flex[:, i, None] * SIGN[side]
            bend = rotation(-roll * X) @ rotation(flex * Y)
            turn = pose.turn(side + "ForeArm") @ bend
        else:
            turn = placed.turn
        pose.set_hand(side, blend(turn, grip.turn, c.hold[:, i, None]))

        # Only the first joint of a finger spreads and takes the additional bend.
        thumbwards = -SIGN[side] * self.rig.turns[side + "Hand"][:, 2]
        for bone, finger, joint, hinge, straight, across in self.rig.fingers[
            side
        ]:
            k = FINGERS.index(finger)
            is_first = float(joint == 0)
            curl = c.curl[:, i, k, None]
            aside = is_first * FINGER_FAN[k] * c.spread[:, i, None] * thumbwards
            flexion = curl + is_first * c.bend[:, i, k, None]

            # From the pose at rest, in which fingers may be bent.
            flexion = FLEXION[finger][joint] * flexion - straight
            turn = rotation(flexion * hinge + curl * across + aside)
            pose.world[bone] = pose.rotation(pose.parent(bone)) @ turn

    def _face(self, c: Controls, times: Array) -> dict[str, Array]:
        """Weights of the face shapes; the player adds blinks."""
        shapes = {}

        # An opening mouth alternates between round and wide vowels.
        mouth = c.mouth.clip(0, 1)
        vowel = 0.5 + 0.5 * np.sin(9 * times)
        shapes["mouth_open"] = 0.7 * mouth
        shapes["mouth_round"] = 0.5 * mouth * vowel + c.round
        shapes["mouth_wide"] = 0.5 * mouth * (1 - vowel) + c.wide

        # Smiles and brows are the same on both sides.
        for side in ("left", "right"):
            shapes[f"smile_{side}"] = 0.8 * c.smile.clip(0, 1)
            shapes[f"brow_up_{side}"] = c.brows.clip(0, 1)
            shapes[f"brow_down_{side}"] = (-c.brows).clip(0, 1)
        return shapes


def _hand_turn(c: Controls, i: int, side: str) -> Array:
    """``[F, 3, 3]`` the hand's turn in the axes of its `pointing` and `facing`."""
    # Mirrored directions become those of this side.
    mirror = np.array([SIGN[side], 1, 1])

    # The palm's direction, orthogonal to the hand's.
    along = unit(c.pointing[:, i] * mirror)
    palm = c.facing[:, i] * mirror
    palm = unit(palm - (palm * along).sum(-1, keepdims=True) * along)
    return frame(along, palm) @ frame(SIGN[side] * X, -Z).T


def _freed(c: Controls, i: int, foot: FootState) -> FootState:
    """The state of a foot in its steps or, as far as it is free, as the passage places it."""
    # The place of a free foot, from body axes to the world.
    x, y, out, height, pitch, toes = c.step[:, i].T
    sign = 1 - 2 * i
    heading = c.path[:, 2]
    cosine = np.cos(heading)
    sine = np.sin(heading)
    own_x = c.path[:, 0] + cosine * sign * x - sine * y
    own_y = c.path[:, 1] + sine * sign * x + cosine * y
    own_place = np.column_stack([own_x, own_y, heading + sign * out])

    # The share by which the foot is free blends both states.
    free = c.free[:, i]
    return foot._replace(
        place=foot.place + free[:, None] * (own_place - foot.place),
        height=foot.height + free * (height - foot.height),
        pitch=foot.pitch + free * (pitch - foot.pitch),
        toes=foot.toes + free * (toes - foot.toes),
    )


def _follow_feet(c: Controls, feet: list[FootState]) -> None:
    """Shifts the body's weight to the standing foot, and swings the arms with the legs."""
    left = feet[0]
    right = feet[1]
    c.pelvis[:, 0] += 0.03 * (right.load - left.load)

    # Metres by which the left foot is ahead of the right one.
    heading = c.path[:, 2]
    forward = np.stack([np.sin(heading), -np.cos(heading)], axis=1)
    apart = (left.place - right.place)[:, :2]
    ahead = c.swing * (apart * forward).sum(axis=1)

    # The arms swing against the legs.
    c.wrist[:, 0, 1] += ahead
    c.wrist[:, 1, 1] -= ahead
    c.wrist[:, :, 2] += 0.03 * c.swing[:, None]
    c.spine[:, 2] += 0.3 * ahead
