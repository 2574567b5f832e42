"""The motion of a rig from a file, in standard axes and on the bones that people have.

Axes and turns are those of :mod:`gsgan.motion.rig`. The up axis and the left side are found from
the posed frames; lengths are relative to the legs.
"""

import re
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from gsgan.motion.humanoid import plain_names
from gsgan.motion.rig import (
    ARM,
    FINGERS,
    LEG,
    REQUIRED,
    SIDES,
    SPINE,
    limb_axes,
    rest_turns,
)
from gsgan.motion.rotations import Array, between, blend, matvec, rotation, unit
from gsgan.skeleton.proportions import axis_name
from gsgan.utils.errors import DataError

# Maximum tilt of trunk and legs in a zero pose that is a standing person.
MAX_STANDING_TILT = np.radians(40)
# Maximum tilt in a frame whose pose is upright enough to serve as a zero pose.
MAX_NEUTRAL_TILT = np.radians(10)
# Maximum tilt of the trunk in frames that may serve otherwise.
MAX_UPRIGHT_TILT = np.radians(30)
# Share of frames in which a person stands, in motions on the floor.
MIN_STANDING_SHARE = 0.1
# frames within this tilt of the best one are used too
SAME_TILT = np.radians(1)
MAX_REFERENCES = 100  # number of frames for calibration
# Share of knees and toes behind the body above which left and right are exchanged.
BACKWARDS = 0.8
# Minimum sine of the slope from ankle to toes of a flat foot: steeper ones are in the air.
STEEPEST = -0.7
# minimum mean sine of the bend at which a limb's plane is known
MIN_BEND = 0.15
# Leg lengths: feet up to this height above the lowest of a second stand on the floor.
HOVER = 0.06
# Metres from the origin that a motion may reach before its drift is subtracted.
ROOM = 0.6
# Standard deviation of the smoothing that separates drift from sway.
DRIFT_SECONDS = 0.5
# Names of joints without side, in lower case and letters only, first choices first.
ALIASES = {
    "Hips": "hips hip pelvis root",
    "UpLeg": "upleg upperleg thigh thighbend hip femur thighstretch",
    "Leg": "leg loleg lowleg lowerleg shin calf knee tibia legstretch",
    "Foot": "ankle foot",
    "ToeBase": "toebase toe toes ball",
    "Arm": "arm uparm uarm upperarm humerus shldr shldrbend armstretch shoulder",
    "ForeArm": "forearm forearmbend farm lowarm loarm lowerarm elbow radius forearmstretch",
    "Hand": "wrist hand",
    "Head": "head",
}
# Rigify numbers the bones of the trunk, from the hips to the head; separators do not count.
RIGIFY = {"DEFspine": "Hips", "DEFspine006": "Head", "spine006": "Head"}
# Regular expressions of the fingers' names.
FINGER_ALIASES = {
    "Thumb": "thumb",
    "Index": "index",
    "Middle": "middle|mid",
    "Ring": "ring",
    "Pinky": "pinky|little",
}
# Mixamo's numbers of the parts of fingers.
PHALANX_NUMBERS = {
    "metacarpal": 1,
    "proximal": 1,
    "intermediate": 2,
    "distal": 3,
}
# Words that mean a side, and neither.
SIDE_WORDS = {"l": "Left", "r": "Right", "left": "Left", "right": "Right"}
MIDDLE_WORDS = ("c", "m", "x")


def find_joints(names: tuple[str, ...]) -> dict[str, int]:
    """Mixamo's bone name → index, for joints named as by Mixamo, MakeHuman, CMU, Blender, ….

    Spine, neck and collarbones are not among them: they follow from the tree of joints.
    """
    joints: dict[str, int] = {}
    ranks: dict[str, int] = {}
    feet: dict[str, int] = {}
    for j, name in enumerate(plain_names(names)):
        # MakeHuman's helpers and end sites are no bones.
        if name.startswith("__") or name.endswith(" end"):
            continue
        bone, rank = _bone(name)
        if bone and rank < ranks.get(bone, 99):
            joints[bone] = j
            ranks[bone] = rank
        if bone.endswith("Foot") and rank > 1:
            feet[bone] = j

    # Beside ankles, SMPL calls the toes feet.
    for bone, j in feet.items():
        if joints[bone] != j:
            joints.setdefault(bone.replace("Foot", "ToeBase"), j)
    return joints


def _bone(name: str) -> tuple[str, int]:
    """The bone that a joint's name means, and the rank of this alias; ("", 0) for other names."""
    _, _, plain = name.rpartition(":")
    rigify = RIGIFY.get(re.sub(r"[\W_]", "", plain))
    if rigify:
        return rigify, 0
    plain = re.sub(r"^DEF[-_]", "", plain)
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", plain)

    # The side is a word of its own, or the beginning of the first word.
    side = ""
    stem = ""
    for word in map(str.lower, words):
        if word in SIDE_WORDS and side in ("", word):
            side = word
        elif word not in MIDDLE_WORDS:
            stem += word

    # The side may be a prefix of the stem itself, as in "lthigh".
    match = re.match(r"(left|right|l|r)(.+)", stem)
    if not side and match and _stem(match[2], sided=True)[0]:
        side, stem = match.groups()

    # Biped numbers fingers from the thumb, and their bones after that.
    match = re.fullmatch(r"bip\d*finger([0-4])([12]?)", stem)
    if match and side:
        number = int(match[2] or 0) + 1
        finger = FINGERS[int(match[1])]
        return f"{SIDE_WORDS[side]}Hand{finger}{number}", 0

    # Prefixes of Mixamo, VRoid and Character Creator.
    stem = re.sub(r"^(mixamorig|j?bip|ccbase)\d*(c(?=hips|head))?", "", stem)
    bone, rank = _stem(stem, sided=bool(side))
    if bone and side:
        bone = SIDE_WORDS[side] + bone
    return bone, rank


def _stem(stem: str, sided: bool) -> tuple[str, int]:
    """The bone without its side, and the rank of the alias."""
    plain = stem.rstrip("0123456789")
    for bone, aliases in ALIASES.items():
        ranked = aliases.split()
        in_middle = bone in ("Hips", "Head")
        if plain in ranked and sided != in_middle:
            # Names with a number come after those without: they may be further segments.
            return bone, 2 * ranked.index(plain) + (plain != stem)

    # Fingers have a number, or the name of a part.
    if not sided:
        return "", 0
    parts = "|".join(PHALANX_NUMBERS)
    for finger, alias in FINGER_ALIASES.items():
        pattern = rf"(?:hand|f)?(?:{alias})(?:finger)?0?(\d?)({parts})?"
        match = re.fullmatch(pattern, stem)
        if match:
            number = match[1] or PHALANX_NUMBERS.get(match[2], 1)
            inside_palm = match[2] == "metacarpal" and finger != "Thumb"
            return f"Hand{finger}{number}", int(inside_palm)
    return "", 0


@dataclass(frozen=True)
class RigMotion:
    """The motion of a rig in a file: joints and their world rotations since the zero pose."""

    # of the J joints, parents first; end sites are called "<joint> end"
    names: tuple[str, ...]
    parents: tuple[int, ...]  # [J], -1 for roots
    offsets: Array  # [J, 3] from the parent in the zero pose, units and axes of the file
    rotations: Array  # [F, J, 3, 3] world, axes of the file
    root: Array  # [F, 3] position of the first joint
    frame_time: float  # seconds
    # [F, J, 3] positions in the parent's axes, in place of the offsets, or None if only the root
    # has position channels
    local: Array | None = None

    def zero_pose(self) -> Array:
        """Joints ``[J, 3]`` without any rotation, the first one at the origin."""
        p = np.zeros((len(self.names), 3))
        for j, parent in enumerate(self.parents[1:], 1):
            p[j] = self.offsets[j]
            if parent >= 0:
                p[j] += p[parent]
        return p

    def pose(self) -> Array:
        """Joints ``[F, J, 3]`` of all frames, units and axes of the file."""
        p = np.zeros((*self.root.shape[:-1], len(self.names), 3))
        p[:, 0] = self.root
        for j, parent in enumerate(self.parents[1:], 1):
            offset = self.offsets[j] if self.local is None else self.local[:, j]
            if parent < 0:
                p[:, j] = offset
            else:
                turned = self.rotations[:, parent] @ offset[..., None]
                p[:, j] = p[:, parent] + turned[..., 0]
        return p


@dataclass(frozen=True)
class StandardMotion:
    """A file's motion in standard axes, starting towards -Y; by Mixamo's bone name."""

    turns: dict[str, Array]  # [F, 3, 3]
    joints: dict[str, Array]  # [F, 3] positions, units of the file
    leg: float  # length of a leg, units of the file
    up: str  # the axis of the file that points up, e.g. "y"


@dataclass(frozen=True)
class Reference:
    """Poses in which bones have known turns: they calibrate the joints' own axes."""

    # [N, J, 3, 3] world rotations of the joints, axes of the file
    rotations: Array
    axes: Array  # [N, 3, 3] rows left, back, up of the person, axes of the file
    joints: Array  # [N, J, 3] positions, axes of the file
    zero: bool  # whether it is the zero pose
    # whether the person stands upright and looks ahead; else the trunk has to be calibrated by the
    # joints' positions
    neutral: bool


def standard_motion(
    rig: RigMotion, path: Path, up: str | None = None
) -> StandardMotion:
    """The motion of a tree of joints on the bones that people have.

    Args:
        rig: as read.
        path: of the file, for messages.
        up: the axis of the file that points up, e.g. "-y"; None finds it from the frames.

    The joints' own axes are calibrated by the zero pose if that is a standing person, else by
    frames in which the person stands, else by the average of the upright frames and, for limbs, by
    the planes in which they bend.

    Raises:
        DataError: when a joint of the limbs is not found, or the file holds two people.
    """
    joint_of = body_joints(rig, path)
    posed = rig.pose()

    # The axis that points up, and left and right.
    zero = rig.zero_pose()[None]

    # A zero pose that stands tells which axis is up.
    highest = _upward(zero, joint_of)
    stands = tilts(zero, joint_of, highest).max() < MAX_STANDING_TILT
    zero_axis = highest if stands else None
    if up is None:
        axis = _upward(posed, joint_of, usual=zero_axis)
    else:
        # The user's axis, with its sign.
        axis = np.zeros(3)
        axis["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    joint_of = _by_side(posed, joint_of, axis)

    # Turns of limbs and fingers. Axes by positions do not depend on the zero pose.
    reference = _reference(rig, posed, joint_of, axis, zero_axis)
    axes = person_axes(posed[:1], joint_of, axis)[0]
    R, turns = _turns(rig, axes, joint_of, reference)

    # Corrections by positions, if no zero pose is known.
    joints = {bone: posed[:, j] @ axes.T for bone, j in joint_of.items()}
    if not reference.zero:
        _bend_in_plane(turns, joints)
        _point_hands(turns, joints)
        if not reference.neutral:
            _flatten_feet(turns, joints)
    turns |= _trunk(rig, joint_of, R)

    # The median length of a leg.
    thigh = np.linalg.norm(joints["LeftUpLeg"] - joints["LeftLeg"], axis=1)
    shin = np.linalg.norm(joints["LeftLeg"] - joints["LeftFoot"], axis=1)
    leg = float(np.median(thigh) + np.median(shin))
    return StandardMotion(
        turns=turns,
        joints=joints,
        leg=leg,
        up=axis_name(axis),
    )


def body_joints(rig: RigMotion, path: Path) -> dict[str, int]:
    """Mixamo's bone name → index, with the fingers' ends.

    Raises:
        DataError: when a joint of the limbs is not found, or the file holds two people.
    """
    joint_of = find_joints(rig.names)
    missing = [
        bone for bone in REQUIRED if bone not in joint_of and bone != "Hips"
    ]
    if missing:
        names = [name for name in rig.names if not name.endswith(" end")]
        raise DataError(
            f"{path}: no joint found for {', '.join(missing)} among {', '.join(names)}; name the "
            f"joints as Mixamo does (LeftUpLeg, LeftLeg, LeftFoot, LeftArm, LeftForeArm, …)"
        )

    # One person has a joint above both legs, and not each limb twice.
    above_left = _line(rig, joint_of["LeftUpLeg"])
    above_right = _line(rig, joint_of["RightUpLeg"])
    shared = [j for j in above_left if j in above_right]

    # Every limb several times means several skeletons.
    counts = []
    for side, bone in product(SIDES, ("UpLeg", "Arm")):
        counts.append(_count(rig, side + bone))
    if not shared or min(counts) > 1:
        raise DataError(
            f"{path} holds more than one person; give a file of one"
        )
    joint_of.setdefault("Hips", shared[-1])

    # The joint after a finger's last bone is its end.
    for bone in list(joint_of):
        if re.search(r"Hand\D+[23]$", bone) and joint_of[bone] in rig.parents:
            end = bone[:-1] + str(int(bone[-1]) + 1)
            joint_of.setdefault(end, rig.parents.index(joint_of[bone]))
    return joint_of


def _count(rig: RigMotion, bone: str) -> int:
    """The number of joints that may be a bone, without the further segments below them."""
    digits = set()
    for j, name in enumerate(rig.names):
        meant, _ = _bone(name)
        if meant == bone:
            digits.add(j)
    return sum(digits.isdisjoint(_line(rig, j)) for j in digits)


def _line(rig: RigMotion, j: int) -> list[int]:
    """The joints above a joint, the root first."""
    line: list[int] = []
    while rig.parents[j] >= 0:
        j = rig.parents[j]
        line.insert(0, j)
    return line


def _middle(p: Array, joint_of: dict[str, int], bone: str) -> Array:
    """The middle ``[..., 3]`` of a pair of joints of poses ``[..., J, 3]``."""
    left = p[..., joint_of["Left" + bone], :]
    right = p[..., joint_of["Right" + bone], :]
    return (left + right) / 2


def _across(p: Array, joint_of: dict[str, int], bone: str) -> Array:
    """The way ``[..., 3]`` from the right to the left joint of poses ``[..., J, 3]``."""
    left = p[..., joint_of["Left" + bone], :]
    right = p[..., joint_of["Right" + bone], :]
    return left - right


def _upward(
    p: Array, joint_of: dict[str, int], usual: Array | None = None
) -> Array:
    """The coordinate axis ``[3]`` that points up.

    Along it, the shoulders are above the hips and these above the feet in the largest share of the
    poses ``[F, J, 3]``. The ``usual`` axis is taken if the person stands along it in some poses and
    lies in the others.
    """
    hips = _middle(p, joint_of, "UpLeg")
    trunk = unit(_middle(p, joint_of, "Arm") - hips)
    legs = unit(hips - _middle(p, joint_of, "Foot"))

    # The smaller cosine of trunk and legs with each axis.
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    cosine = np.minimum(trunk @ axes.T, legs @ axes.T)

    # The usual axis, if the person stands along it in enough poses.
    standing = (cosine > np.cos(MAX_UPRIGHT_TILT)).mean(axis=0)
    if (
        usual is not None
        and standing[(axes @ usual).argmax()] > MIN_STANDING_SHARE
    ):
        return usual

    # The mean direction decides between axes with the same share.
    above = (cosine > 0.5).mean(axis=0)
    score = above + 1e-3 * (trunk + legs).mean(axis=0) @ axes.T
    return np.asarray(axes[score.argmax()])


def person_axes(p: Array, joint_of: dict[str, int], up: Array) -> Array:
    """``[..., 3, 3]`` rows left, back, up of poses ``[..., J, 3]``; ``up [..., 3]`` is kept."""
    left = _across(p, joint_of, "UpLeg")
    vertical = (left * up).sum(-1, keepdims=True) * up
    left = unit(left - vertical)
    up = np.broadcast_to(up, left.shape)
    return np.stack([left, np.cross(up, left), up], axis=-2)


def _by_side(p: Array, joint_of: dict[str, int], up: Array) -> dict[str, int]:
    """The joints; left and right are exchanged if knees and toes would point backwards."""
    # Votes above 0 are behind the line from hip to ankle, or behind the ankle.
    back = person_axes(p, joint_of, up)[:, 1]
    votes = []
    for side in SIDES:
        hip = p[:, joint_of[side + "UpLeg"]]
        knee = p[:, joint_of[side + "Leg"]]
        ankle = p[:, joint_of[side + "Foot"]]
        bend = knee - (hip + ankle) / 2
        votes.append((bend * back).sum(-1))
        if side + "ToeBase" in joint_of:
            toe = p[:, joint_of[side + "ToeBase"]]
            votes.append(((toe - ankle) * back).sum(-1))
    if np.mean(np.stack(votes) > 0) < BACKWARDS:
        return joint_of

    # The same joints by the names of the other side.
    exchanged = {}
    for bone, j in joint_of.items():
        if bone.startswith("Left"):
            bone = bone.replace("Left", "Right", 1)
        elif bone.startswith("Right"):
            bone = bone.replace("Right", "Left", 1)
        exchanged[bone] = j
    return exchanged


def tilts(p: Array, joint_of: dict[str, int], up: Array) -> Array:
    """Angles ``[..., 7]`` between poses ``[..., J, 3]`` and a person who stands upright.

    Radians, for the trunk, the left and right thigh and shin, hips and shoulders.
    """
    axes = person_axes(p, joint_of, up)
    left = axes[..., 0, :]
    up = axes[..., 2, :]

    # Directions of the body's parts, and those of a person who stands.
    trunk = _middle(p, joint_of, "Arm") - _middle(p, joint_of, "UpLeg")
    pairs = [(trunk, up)]
    for side in SIDES:
        hip = p[..., joint_of[side + "UpLeg"], :]
        knee = p[..., joint_of[side + "Leg"], :]
        ankle = p[..., joint_of[side + "Foot"], :]
        pairs.append((knee - hip, -up))
        pairs.append((ankle - knee, -up))
    for bone in ("UpLeg", "Arm"):
        pairs.append((_across(p, joint_of, bone), left))

    cosines = []
    for direction, standing in pairs:
        cosines.append((unit(direction) * unit(standing)).sum(-1))
    return np.arccos(np.stack(cosines, axis=-1).clip(-1, 1))


def _reference(
    rig: RigMotion,
    posed: Array,
    joint_of: dict[str, int],
    up: Array,
    zero_axis: Array | None,
) -> Reference:
    """The zero pose, if that is a person who stands along ``zero_axis``; else frames."""
    if zero_axis is not None:
        zero = rig.zero_pose()[None]
        return Reference(
            rotations=np.broadcast_to(np.eye(3), (1, *rig.rotations.shape[1:])),
            axes=person_axes(zero, joint_of, zero_axis),
            joints=zero,
            zero=True,
            neutral=True,
        )

    # The frames that stand as well as the best one, else all whose trunk is upright.
    tilt = tilts(posed, joint_of, up)
    worst = tilt.max(axis=-1)
    best = float(worst.min())
    neutral = best < MAX_NEUTRAL_TILT
    if neutral:
        chosen = np.flatnonzero(worst < best + SAME_TILT)
    else:
        # Without a neutral pose, the frames in which at least the trunk is
        # upright.
        trunk = tilt[:, 0]
        limit = max(MAX_UPRIGHT_TILT, float(trunk.min()) + SAME_TILT)
        chosen = np.flatnonzero(trunk < limit)

    # A few of them, evenly spread.
    chosen = chosen[:: max(1, len(chosen) // MAX_REFERENCES)]
    return Reference(
        rotations=rig.rotations[chosen],
        axes=person_axes(posed[chosen], joint_of, up),
        joints=posed[chosen],
        zero=False,
        neutral=neutral,
    )


def _turns(
    rig: RigMotion, axes: Array, joint_of: dict[str, int], reference: Reference
) -> tuple[Array, dict[str, Array]]:
    """Turns ``[F, J, 3, 3]`` of all joints, and of the known bones with their turns at rest."""
    # Turns of the limbs in the reference poses, by joint positions.
    at_rest = []
    for A, p in zip(reference.axes, reference.joints, strict=True):
        joints = {bone: A @ p[j] for bone, j in joint_of.items()}
        at_rest.append(rest_turns(joints))
    if not reference.neutral:
        _follow_positions(at_rest, joint_of, reference)

    # A joint's turn is R @ C: its world rotation R in the person's axes, times the constant C
    # that gives the known turns in the reference poses.
    # [N, J, 3, 3]
    to_rest = reference.rotations.mT @ reference.axes.mT[:, None]
    R = axes @ rig.rotations
    turns = {}
    for bone, j in joint_of.items():
        if bone.endswith("4"):  # a finger's tip follows its last bone
            continue
        # Fingers of one joint rest as the hand.
        hand = re.sub("(Hand).+", r"\1", bone)
        rest = [turn.get(bone, turn.get(hand, np.eye(3))) for turn in at_rest]
        turns[bone] = R[:, j] @ _mean(to_rest[:, j] @ np.stack(rest))

    # All joints as parts of the trunk.
    trunk = np.stack([turn.get("Hips", np.eye(3)) for turn in at_rest])
    constants = [_mean(to_rest[:, j] @ trunk) for j in range(to_rest.shape[1])]
    return R @ np.stack(constants), turns


def _follow_positions(
    at_rest: list[dict[str, Array]],
    joint_of: dict[str, int],
    reference: Reference,
) -> None:
    """Adds the turns of the trunk and the feet of frames in which the person does not stand."""
    for turn, A, p in zip(
        at_rest, reference.axes, reference.joints, strict=True
    ):
        # The trunk, by the line from hips to shoulders.
        trunk = A @ (
            _middle(p, joint_of, "Arm") - _middle(p, joint_of, "UpLeg")
        )
        turn["Hips"] = between(np.array([0.0, 0, 1]), trunk)

        # Feet, by their heading.
        for side in SIDES:
            if side + "ToeBase" in joint_of:
                toe = A @ (
                    p[joint_of[side + "ToeBase"]] - p[joint_of[side + "Foot"]]
                )
                foot = between(np.array([0.0, -1, 0]), toe * (1, 1, 0))
                turn[side + "Foot"] = foot
                turn[side + "ToeBase"] = foot


def _bend_in_plane(turns: dict[str, Array], joints: dict[str, Array]) -> None:
    """Twists limbs about their length so that elbows and knees bend in their planes on average."""
    for side, part in product(SIDES, (LEG, ARM)):
        first, second, end = [side + bone for bone in part]
        along, hinge = limb_axes(part, side)

        # The direction of the bend about the limb's length, as a complex number: 1 is forwards, 1j
        # is out of the plane. Larger bends count more.
        lower = unit(joints[end] - joints[second])
        local = matvec(turns[first].mT, lower)
        away = local @ hinge
        forward = local @ np.cross(hinge, along)

        # As a complex number: its angle is the direction of the bend, and its
        # size the weight.
        bend = forward + 1j * away
        mean = (bend * np.hypot(forward, away)).mean()
        if abs(mean) <= MIN_BEND**2:
            continue

        # The twist that takes it to 1; a hand without a palm follows its arm.
        twisted = rotation(along * float(np.angle(mean)))
        turns[first] = turns[first] @ twisted
        turns[second] = turns[second] @ twisted
        palm_known = f"{side}HandMiddle1" in joints
        if part == ARM and not palm_known:
            turns[end] = turns[end] @ twisted


def _point_hands(turns: dict[str, Array], joints: dict[str, Array]) -> None:
    """Points hands without a whole palm along their middle finger, thumbs to the front."""
    for side in SIDES:
        hand = side + "Hand"
        middle = f"{side}HandMiddle1"
        if middle not in joints or f"{side}HandPinky1" in joints:
            continue
        # Along the arm's direction in the standard pose.
        along, _ = limb_axes(ARM, side)
        calibration = between(along, _local(turns, joints, hand, middle))

        # The twist, by the last known joint of the thumb.
        thumbs = [f"{side}HandThumb{k}" for k in (1, 2, 3)]
        thumbs = [bone for bone in thumbs if bone in joints]
        if thumbs:
            thumb = calibration.T @ _local(turns, joints, hand, thumbs[-1])
            thumb = thumb * (0, 1, 1)
            calibration = calibration @ between(np.array([0.0, -1, 0]), thumb)

        # The fingers turn with the hand.
        for bone in turns:
            if bone.startswith(hand):
                turns[bone] = turns[bone] @ calibration


def _flatten_feet(turns: dict[str, Array], joints: dict[str, Array]) -> None:
    """Pitches the feet so that they are flat, on average, in the frames in which they rest."""
    for side in SIDES:
        foot = side + "Foot"
        toe = side + "ToeBase"
        if toe not in joints:
            continue

        # A foot rests in the slowest fifth of the frames. The first frame's step is to the second.
        ends = np.stack([joints[foot], joints[toe]])
        second = ends[:, :2][:, -1:]
        speed = np.linalg.norm(np.diff(ends, axis=1, prepend=second), axis=-1)
        rests = np.argsort(speed.max(axis=0))[: 1 + len(joints[foot]) // 5]

        # At rest the foot has the slope of a flat foot, and the toes do not bend.
        ahead = unit(joints[toe] - joints[foot])
        down = float(np.median(ahead[rests, 2]).clip(STEEPEST, 0))
        flat = np.array([0, -np.sqrt(1 - down**2), down])
        turns[foot] = turns[foot] @ between(
            flat, _local(turns, joints, foot, toe)
        )
        turns[toe] = turns[toe] @ _mean(
            turns[toe][rests].mT @ turns[foot][rests]
        )


def _local(
    turns: dict[str, Array], joints: dict[str, Array], bone: str, end: str
) -> Array:
    """The mean direction ``[3]`` from a bone's joint to another, in the bone's axes."""
    direction = unit(joints[end] - joints[bone])[..., None]
    return unit((turns[bone].mT @ direction)[..., 0].mean(axis=0))


def _mean(R: Array) -> Array:
    """The mean ``[3, 3]`` of rotations ``[N, 3, 3]``."""
    if len(R) == 1:
        return R[0]
    return Rotation.from_matrix(R).mean().as_matrix()


def floor_under(lowest: Array, leg: float, step: float) -> Array:
    """The floor's height ``[F]`` below feet at heights ``[F]``; one foot stands except in jumps.

    Jumps lose `HOVER`: a floor that follows the lowest of a second may be too low by that much.
    """
    # The lowest of a second, smoothed.
    window = max(1, round(1 / step))
    floor = gaussian_filter1d(minimum_filter1d(lowest, window), window / 4)

    # A foot that is not much higher stands on it.
    above = np.minimum(lowest - floor, HOVER * leg)
    return np.asarray(floor + above)


def drift(path: Array, step: float) -> Array:
    """The drift ``[F, 2]`` of a horizontal path: subtracting it keeps the path near the origin."""
    # A motion in one place has none.
    middle = (path.min(axis=0) + path.max(axis=0)) / 2
    if np.linalg.norm(path - middle, axis=1).max() <= ROOM:
        return np.broadcast_to(middle, path.shape)

    # Point reflections at both ends continue the path in the same direction.
    pad = len(path) - 1
    odd = np.pad(path, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
    smooth = gaussian_filter1d(odd, DRIFT_SECONDS / step, axis=0)
    return np.asarray(smooth[pad : pad + len(path)])


def _trunk(
    rig: RigMotion, joint_of: dict[str, int], R: Array
) -> dict[str, Array]:
    """Turns of spine, neck and collarbones, whatever their number, by their place in the tree."""
    left = _line(rig, joint_of["LeftArm"])
    right = _line(rig, joint_of["RightArm"])
    turns = {}

    # The spine is above both arms but not above the legs; the file's bones are interpolated.
    hips = [*_line(rig, joint_of["LeftUpLeg"]), joint_of["Hips"]]
    spine = [j for j in left if j in right and j not in hips]

    # The standard's joints lie at even steps along the file's spine.
    chain = [joint_of["Hips"], *spine]
    for k, bone in enumerate(SPINE, 1):
        at = k * len(spine) / len(SPINE)
        below = int(at)
        lower = chain[below]
        upper = chain[min(below + 1, len(spine))]
        turns[bone] = blend(R[:, lower], R[:, upper], at - below)

    # The neck is above the head only; without one, it turns half-way.
    if "Head" in joint_of:
        head = joint_of["Head"]
        neck = [j for j in _line(rig, head) if j not in left]
        if neck:
            turns["Neck"] = R[:, neck[0]]
        else:
            turns["Neck"] = blend(R[:, chain[-1]], R[:, head], 0.5)

    # A collarbone is above one arm only; the last one carries the arm.
    for side, line, other in (("Left", left, right), ("Right", right, left)):
        collar = [j for j in line if j not in other]
        if collar:
            turns[side + "Shoulder"] = R[:, collar[-1]]
    return turns
