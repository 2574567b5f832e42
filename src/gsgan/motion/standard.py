"""The motion of a rig from a file, in standard axes and on the bones that people have.

Convention: that of :mod:`gsgan.motion.rig`. The up axis and the left side are found from the posed
frames, lengths follow from the legs.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from gsgan.data.proportions import axis_name
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
from gsgan.motion.rotations import Array, between, blend, rotation, unit
from gsgan.utils.errors import DataError

# largest tilt of trunk and legs in a zero pose that is a standing person
STANDING = np.radians(40)
# the same, in a frame that stands so well that it serves as a zero pose
NEUTRAL = np.radians(10)
UPRIGHT = np.radians(30)  # largest tilt of the trunk in frames that may serve otherwise
SELDOM = 0.1  # share of frames in which a person stands, in motions on the floor
SAME = np.radians(1)  # frames that stand as well as the best one
MOST = 100  # frames that calibrate
# share of knees and toes behind the body from which names are of the other side
BACKWARDS = 0.8
# sine of the slope from ankle to toes of a flat foot: steeper ones are in the air
STEEPEST = -0.7
BENT = 0.15  # mean sine of the bend from which a limb's plane is known
# legs: feet this high above the lowest of a second stand on the floor; no jump
HOVER = 0.06
# metres from the origin that a motion may reach before its drift is subtracted
ROOM = 0.6
# standard deviation of the smoothing that separates drift from sway
DRIFT_SECONDS = 0.5
# Names of joints without side, in lower case and letters only, first choices first.
ALIASES = {
    "Hips": "hips hip pelvis root",
    "UpLeg": "upleg upperleg thigh thighbend hip femur",
    "Leg": "leg loleg lowleg lowerleg shin calf knee tibia",
    "Foot": "ankle foot",
    "ToeBase": "toebase toe toes ball",
    "Arm": "arm uparm uarm upperarm humerus shldr shldrbend shoulder",
    "ForeArm": "forearm forearmbend farm lowarm loarm lowerarm elbow radius",
    "Hand": "wrist hand",
    "Head": "head",
}
FINGER_ALIASES = {finger: finger.lower() for finger in FINGERS} | {
    "Middle": "middle|mid",
    "Pinky": "pinky|little",
}
PARTS = {"metacarpal": 1, "proximal": 1, "intermediate": 2, "distal": 3}


def known_joints(names: tuple[str, ...]) -> dict[str, int]:
    """Mixamo's bone name → index, for joints named as by Mixamo, MakeHuman, CMU, Blender, ….

    Spine, neck and collarbones are not among them: they follow from the tree of joints.
    """
    found: dict[str, tuple[int, int]] = {}
    for j, name in enumerate(names):
        # MakeHuman's helpers; end sites
        if name.startswith("__") or name.endswith(" end"):
            continue
        bone, rank = _bone(name)
        if bone and rank < found.get(bone, (99, 0))[0]:
            found[bone] = (rank, j)
    return {bone: j for bone, (_, j) in found.items()}


def _bone(name: str) -> tuple[str, int]:
    """The bone that a joint's name means, and the rank of this alias; ("", 0) for other names."""
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name.split(":")[-1])
    words = [w.lower() for w in words]
    sided = [w for w in words if w in ("l", "r", "left", "right")]
    stem = "".join(w for w in words if w not in sided[:1])
    if not sided and (match := re.match(r"(left|right|l|r)(.+)", stem)):
        sided = [match[1]]
        rest = match[2]
        if not _stem(rest, True)[0]:
            sided = []
            rest = stem
        stem = rest
    bone, rank = _stem(
        re.sub(r"^(mixamorig|j?bip)\d*(c(?=hips|head))?", "", stem), bool(sided)
    )
    side = {"l": "Left", "r": "Right"}[sided[0][0]] if sided else ""
    return side + bone if bone else "", rank


def _stem(stem: str, sided: bool) -> tuple[str, int]:
    plain = stem.rstrip("0123456789")
    for bone, aliases in ALIASES.items():
        if plain in aliases.split() and sided != (bone in ("Hips", "Head")):
            return bone, aliases.split().index(plain)
    for finger, alias in FINGER_ALIASES.items():
        match = re.fullmatch(
            rf"(?:hand|f)?(?:{alias})(?:finger)?0?(\d?)({'|'.join(PARTS)})?", stem
        )
        if match and sided:
            return f"Hand{finger}{match[1] or PARTS.get(match[2], 1)}", 0
    return "", 0


@dataclass(frozen=True)
class RigMotion:
    """The motion of a rig as a file has it: joints, parents first, and their world rotations since
    the zero pose.

    Args:
        names: of the J joints; end sites are called "<joint> end".
        parents: ``[J]``, -1 for roots.
        offsets: ``[J, 3]`` from the parent in the zero pose, units and axes of the file.
        rotations: ``[F, J, 3, 3]`` world, axes of the file.
        root: ``[F, 3]`` position of the first joint.
        frame_time: seconds.
        local: ``[F, J, 3]`` positions in the parent's axes, in place of the offsets, or None where
            only the root has position channels.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Array
    rotations: Array
    root: Array
    frame_time: float
    local: Array | None = None

    def zero_pose(self) -> Array:
        """Joints ``[J, 3]`` without any rotation, the first one at the origin."""
        p = np.zeros((len(self.names), 3))
        for j, parent in enumerate(self.parents[1:], 1):
            p[j] = p[parent] + self.offsets[j] if parent >= 0 else self.offsets[j]
        return p

    def posed(self) -> Array:
        """Joints ``[F, J, 3]`` of all frames, units and axes of the file."""
        p = np.zeros((*self.root.shape[:-1], len(self.names), 3))
        p[:, 0] = self.root
        for j, parent in enumerate(self.parents[1:], 1):
            offset = self.offsets[j] if self.local is None else self.local[:, j]
            if parent < 0:
                p[:, j] = offset
            else:
                p[:, j] = (
                    p[:, parent]
                    + (self.rotations[:, parent] @ offset[..., None])[..., 0]
                )
        return p


@dataclass(frozen=True)
class StandardMotion:
    """A file's motion in standard axes, starting towards -Y; by Mixamo's bone name."""

    turns: dict[str, Array]  # [F, 3, 3]
    joints: dict[str, Array]  # [F, 3] positions, units of the file
    leg: float  # the legs' length, units of the file
    up: str  # the axis of the file that points up, e.g. "y"


@dataclass(frozen=True)
class Reference:
    """Poses in which bones have known turns: they calibrate the joints' own axes.

    Args:
        rotations: ``[N, J, 3, 3]`` world rotations of the joints, axes of the file.
        axes: ``[N, 3, 3]`` rows left, back, up of the person, axes of the file.
        joints: ``[N, J, 3]`` positions, axes of the file.
        zero: whether it is the zero pose.
        neutral: whether the person stands upright and looks ahead; else the trunk has to be
            calibrated by the joints' positions.
    """

    rotations: Array
    axes: Array
    joints: Array
    zero: bool
    neutral: bool


def standard_motion(
    rig: RigMotion, path: Path, up: str | None = None
) -> StandardMotion:
    """The motion of a tree of joints on the bones that people have.

    Args:
        rig: as read.
        path: of the file, for messages.
        up: the axis of the file that points up, e.g. "-y"; None finds it from the frames.

    The joints' own axes are calibrated by the zero pose where that is a standing person, else by
    frames in which the person stands, else by the average of the upright frames and, for limbs, by
    the planes in which they bend.

    Raises:
        DataError: when a joint of the limbs is not found, or the file holds two people.
    """
    known = body_joints(rig, path)
    posed = rig.posed()
    zero = rig.zero_pose()[None]
    axis = np.zeros(3)
    at_zero = _upward(zero, known)
    own = at_zero if tilts(zero, known, at_zero).max() < STANDING else None
    if up is None:
        axis = _upward(posed, known, usual=own)
    else:
        axis["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    known = _by_side(posed, known, axis)
    reference = _reference(rig, posed, known, axis, own)
    # by positions: whatever the zero pose is
    axes = person_axes(posed[:1], known, axis)[0]
    R, turns = _turns(rig, axes, known, reference)
    joints = {bone: posed[:, j] @ axes.T for bone, j in known.items()}
    if not reference.zero:
        _bend_in_plane(turns, joints)
        _point_hands(turns, joints)
        if not reference.neutral:
            _flatten_feet(turns, joints)
    turns |= _trunk(rig, known, R)
    hip, knee, ankle = (joints["Left" + bone] for bone in LEG)
    thigh = np.linalg.norm(hip - knee, axis=1)
    shin = np.linalg.norm(knee - ankle, axis=1)
    leg = float(np.median(thigh) + np.median(shin))
    return StandardMotion(turns, joints, leg, axis_name(axis))


def body_joints(rig: RigMotion, path: Path) -> dict[str, int]:
    """Mixamo's bone name → index, with the fingers' ends.

    Raises:
        DataError: when a joint of the limbs is not found, or the file holds two people.
    """
    known = known_joints(rig.names)
    if missing := [bone for bone in REQUIRED if bone not in known and bone != "Hips"]:
        names = [name for name in rig.names if not name.endswith(" end")]
        raise DataError(
            f"{path}: no joint found for {', '.join(missing)} among {', '.join(names)}; name the "
            f"joints as Mixamo does (LeftUpLeg, LeftLeg, LeftFoot, LeftArm, LeftForeArm, …)"
        )
    lines = [_line(rig, known[side + "UpLeg"]) for side in SIDES]
    shared = [j for j in lines[0] if j in lines[1]]
    if (
        not shared
        or min(_count(rig, side + bone) for side in SIDES for bone in ("UpLeg", "Arm"))
        > 1
    ):
        raise DataError(f"{path} holds more than one person; give a file of one")
    known.setdefault("Hips", shared[-1])
    for bone in list(known):
        ends = [j for j, parent in enumerate(rig.parents) if parent == known[bone]]
        if re.search(r"Hand\D+[23]$", bone) and ends:
            known.setdefault(bone[:-1] + str(int(bone[-1]) + 1), ends[0])
    return known


def _count(rig: RigMotion, bone: str) -> int:
    """The number of joints that may be a bone, without the further segments below them."""
    found = [j for j, name in enumerate(rig.names) if _bone(name)[0] == bone]
    return sum(not set(_line(rig, j)) & set(found) for j in found)


def _line(rig: RigMotion, j: int) -> list[int]:
    """The joints above a joint, the root first."""
    line: list[int] = []
    while (j := rig.parents[j]) >= 0:
        line.insert(0, j)
    return line


def _middle(p: Array, known: dict[str, int], bone: str) -> Array:
    """``[..., 3]`` the middle of a pair of joints of poses ``[..., J, 3]``."""
    return (p[..., known["Left" + bone], :] + p[..., known["Right" + bone], :]) / 2


def _upward(p: Array, known: dict[str, int], usual: Array | None = None) -> Array:
    """``[3]`` the coordinate axis that points up: along it, the shoulders are above the hips and
    these above the feet in the largest share of the poses ``[F, J, 3]``; or the ``usual`` one, if
    the person stands along it in some poses and lies in the others."""
    chest = _middle(p, known, "Arm")
    hips = _middle(p, known, "UpLeg")
    feet = _middle(p, known, "Foot")
    trunk = unit(chest - hips)
    legs = unit(hips - feet)
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    least = np.minimum(trunk @ axes.T, legs @ axes.T)
    standing = (least > np.cos(UPRIGHT)).mean(axis=0)
    if usual is not None and standing[(axes @ usual).argmax()] > SELDOM:
        return usual
    above = (least > 0.5).mean(axis=0)
    return np.asarray(
        axes[(above + 1e-3 * (trunk + legs).mean(axis=0) @ axes.T).argmax()]
    )


def person_axes(p: Array, known: dict[str, int], up: Array) -> Array:
    """``[..., 3, 3]`` rows left, back, up of poses ``[..., J, 3]``; ``up [..., 3]`` is kept."""
    left = p[..., known["LeftUpLeg"], :] - p[..., known["RightUpLeg"], :]
    left = unit(left - (left * up).sum(-1, keepdims=True) * up)
    up = np.broadcast_to(up, left.shape)
    return np.stack([left, np.cross(up, left), up], axis=-2)


def _by_side(p: Array, known: dict[str, int], up: Array) -> dict[str, int]:
    """The joints, left and right exchanged where knees and toes would point backwards."""
    back = person_axes(p, known, up)[:, 1]
    votes = []
    for side in SIDES:
        hip, knee, ankle = (p[:, known[side + bone]] for bone in LEG)
        votes.append(((knee - (hip + ankle) / 2) * back).sum(-1))
        if side + "ToeBase" in known:
            votes.append(((p[:, known[side + "ToeBase"]] - ankle) * back).sum(-1))
    if np.mean(np.stack(votes) > 0) < BACKWARDS:
        return known
    other = {"Left": "Right", "Right": "Left"}
    return {
        re.sub("^(Left|Right)", lambda m: other[m[1]], b): j for b, j in known.items()
    }


def tilts(p: Array, known: dict[str, int], up: Array) -> Array:
    """``[..., 7]`` radians by which trunk, thighs, shins, hips and shoulders of poses ``[..., J,
    3]`` differ from those of a person who stands upright."""
    axes = person_axes(p, known, up)
    found = [(_middle(p, known, "Arm") - _middle(p, known, "UpLeg"), axes[..., 2, :])]
    for side in SIDES:
        hip, knee, ankle = (p[..., known[side + bone], :] for bone in LEG)
        found += [(knee - hip, -axes[..., 2, :]), (ankle - knee, -axes[..., 2, :])]
    for bone in ("UpLeg", "Arm"):
        across = p[..., known["Left" + bone], :] - p[..., known["Right" + bone], :]
        found.append((across, axes[..., 0, :]))
    cosines = [(unit(v) * unit(w)).sum(-1) for v, w in found]
    return np.arccos(np.stack(cosines, axis=-1).clip(-1, 1))


def _reference(
    rig: RigMotion, posed: Array, known: dict[str, int], up: Array, own: Array | None
) -> Reference:
    """The zero pose, if that is a person who stands along the axis ``own``; else frames."""
    if own is not None:
        zero = rig.zero_pose()[None]
        eye = np.broadcast_to(np.eye(3), (1, *rig.rotations.shape[1:]))
        return Reference(eye, person_axes(zero, known, own), zero, True, True)
    tilt = tilts(posed, known, up)
    score = tilt.max(axis=-1)
    best = float(score.min())
    neutral = best < NEUTRAL
    if neutral:
        chosen = np.flatnonzero(score < best + SAME)
    else:
        chosen = np.flatnonzero(
            tilt[:, 0] < max(UPRIGHT, float(tilt[:, 0].min()) + SAME)
        )
    chosen = chosen[:: max(1, len(chosen) // MOST)]
    p = posed[chosen]
    return Reference(
        rig.rotations[chosen], person_axes(p, known, up), p, False, neutral
    )


def _turns(
    rig: RigMotion, axes: Array, known: dict[str, int], reference: Reference
) -> tuple[Array, dict[str, Array]]:
    """Turns ``[F, J, 3, 3]`` of all joints, and of the known bones with their turns at rest."""
    back = reference.axes.mT
    own = np.swapaxes(reference.rotations, -1, -2)  # [N, J, 3, 3]
    at_rest = [
        rest_turns({bone: A @ p[j] for bone, j in known.items()})
        for A, p in zip(reference.axes, reference.joints, strict=True)
    ]
    if not reference.neutral:
        _follow_positions(at_rest, known, reference)
    R = axes @ rig.rotations
    turns = {}
    for bone, j in known.items():
        if bone.endswith("4"):  # a finger's tip follows its last bone
            continue
        hand = re.sub("(Hand).+", r"\1", bone)  # fingers of one joint rest as the hand
        rest = np.stack([turn.get(bone, turn.get(hand, np.eye(3))) for turn in at_rest])
        turns[bone] = R[:, j] @ _mean(own[:, j] @ back @ rest)
    trunk = np.stack([turn.get("Hips", np.eye(3)) for turn in at_rest])
    free = np.stack([_mean(own[:, j] @ back @ trunk) for j in range(own.shape[1])])
    return R @ free, turns


def _follow_positions(
    at_rest: list[dict[str, Array]], known: dict[str, int], reference: Reference
) -> None:
    """Adds the turns of the trunk and the feet of frames in which the person does not stand."""
    for turn, A, p in zip(at_rest, reference.axes, reference.joints, strict=True):
        trunk = A @ (_middle(p, known, "Arm") - _middle(p, known, "UpLeg"))
        turn["Hips"] = between(np.array([0.0, 0, 1]), trunk)
        for side in SIDES:
            if side + "ToeBase" in known:
                toe = A @ (p[known[side + "ToeBase"]] - p[known[side + "Foot"]])
                turn[side + "Foot"] = between(np.array([0.0, -1, 0]), toe * (1, 1, 0))
                turn[side + "ToeBase"] = turn[side + "Foot"]


def _bend_in_plane(turns: dict[str, Array], joints: dict[str, Array]) -> None:
    """Twists limbs about their length so that elbows and knees bend in their planes on average."""
    for side in SIDES:
        for part in (LEG, ARM):
            first, second, end = (side + bone for bone in part)
            along, hinge = limb_axes(part, side)
            lower = unit(joints[end] - joints[second])
            local = (np.swapaxes(turns[first], -1, -2) @ lower[..., None])[..., 0]
            away = local @ hinge
            forth = local @ np.cross(hinge, along)
            mean = ((forth + 1j * away) * np.hypot(forth, away)).mean()
            if abs(mean) > BENT**2:
                twisted = rotation(along * float(np.angle(mean)))
                turns[first] = turns[first] @ twisted
                turns[second] = turns[second] @ twisted
                # its palm is not known
                if part == ARM and f"{side}HandMiddle1" not in joints:
                    turns[end] = turns[end] @ twisted


def _point_hands(turns: dict[str, Array], joints: dict[str, Array]) -> None:
    """Points hands without a whole palm along their middle finger, thumbs to the front."""
    for side in SIDES:
        hand = side + "Hand"
        middle = f"{side}HandMiddle1"
        if middle not in joints or f"{side}HandPinky1" in joints:
            continue
        along, _ = limb_axes(ARM, side)
        calibration = between(along, _local(turns, joints, hand, middle))
        thumbs = [bone for k in (1, 2, 3) if (bone := f"{side}HandThumb{k}") in joints]
        if thumbs:
            thumb = calibration.T @ _local(turns, joints, hand, thumbs[-1]) * (0, 1, 1)
            calibration = calibration @ between(np.array([0.0, -1, 0]), thumb)
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
        ahead = unit(joints[toe] - joints[foot])
        ends = np.stack([joints[foot], joints[toe]])
        steps = np.diff(ends, axis=1, prepend=ends[:, :2][:, -1:])
        speed = np.linalg.norm(steps, axis=-1)
        rests = np.argsort(speed.max(axis=0))[: 1 + len(ahead) // 5]
        down = float(np.median(ahead[rests, 2]).clip(STEEPEST, 0))
        flat = np.array([0, -np.sqrt(1 - down**2), down])
        turns[foot] = turns[foot] @ between(flat, _local(turns, joints, foot, toe))
        turns[toe] = turns[toe] @ _mean(turns[toe][rests].mT @ turns[foot][rests])


def _local(
    turns: dict[str, Array], joints: dict[str, Array], bone: str, end: str
) -> Array:
    """``[3]`` direction from a bone's joint to another, in the bone's axes, mean over frames."""
    away = unit(joints[end] - joints[bone])[..., None]
    return unit((turns[bone].mT @ away)[..., 0].mean(axis=0))


def _mean(R: Array) -> Array:
    """The mean ``[3, 3]`` of rotations ``[N, 3, 3]``."""
    return np.asarray(
        R[0] if len(R) == 1 else Rotation.from_matrix(R).mean().as_matrix()
    )


def floor_under(lowest: Array, leg: float, step: float) -> Array:
    """``[F]`` the floor's height below feet at heights ``[F]``, one of which stands but in jumps.

    Jumps lose `HOVER`: a floor that follows the lowest of a second may be too low by that much.
    """
    window = max(1, round(1 / step))
    floor = gaussian_filter1d(minimum_filter1d(lowest, window), window / 4)
    return np.asarray(floor + np.minimum(lowest - floor, HOVER * leg))


def drift(path: Array, step: float) -> Array:
    """``[F, 2]`` what to subtract from a horizontal path so that it stays near the origin."""
    middle = (path.min(axis=0) + path.max(axis=0)) / 2
    if np.linalg.norm(path - middle, axis=1).max() <= ROOM:
        return np.broadcast_to(middle, path.shape)
    pad = len(path) - 1
    odd = np.pad(path, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
    smooth = gaussian_filter1d(odd, DRIFT_SECONDS / step, axis=0)
    return np.asarray(smooth[pad : pad + len(path)])


def _trunk(rig: RigMotion, known: dict[str, int], R: Array) -> dict[str, Array]:
    """Turns of spine, neck and collarbones, whatever their number, by their place in the tree."""

    left = _line(rig, known["LeftArm"])
    right = _line(rig, known["RightArm"])
    legs = _line(rig, known["LeftUpLeg"])
    spine = [j for j in left if j in right and j not in (*legs, known["Hips"])]
    chain = [R[:, j] for j in (known["Hips"], *spine)]
    turns = {}
    for k, bone in enumerate(SPINE, 1):
        at = k * len(spine) / len(SPINE)
        low = int(at)
        turns[bone] = blend(chain[low], chain[min(low + 1, len(spine))], at - low)
    if "Head" in known:
        neck = [j for j in _line(rig, known["Head"]) if j not in left]
        turns["Neck"] = (
            R[:, neck[0]] if neck else blend(chain[-1], R[:, known["Head"]], 0.5)
        )
    for side, line, other in (("Left", left, right), ("Right", right, left)):
        if collar := [j for j in line if j not in other]:
            turns[side + "Shoulder"] = R[:, collar[-1]]
    return turns
