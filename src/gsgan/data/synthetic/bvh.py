"""Motion capture in the BVH format, on any character.

Convention: that of :mod:`gsgan.data.synthetic.retarget`. A file's up axis and left side are found
from its rest pose, lengths follow from the legs.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation, Slerp

from gsgan.data.synthetic.character import Character, Motion
from gsgan.data.synthetic.motion import blinks
from gsgan.data.synthetic.retarget import (
    FINGERS,
    LEG,
    REQUIRED,
    SIDES,
    SPINE,
    Array,
    Pose,
    Rig,
    blend,
    rest_turns,
    rotation,
    unit,
)
from gsgan.utils.errors import DataError

HOVER = 0.06  # legs: feet this high above the lowest of a second stand on the floor; no jump
ROOM = 0.6  # metres from the origin that a motion may reach before its drift is subtracted
DRIFT_SECONDS = 0.5  # standard deviation of the smoothing that separates drift from sway
# A foot stands where it is this low and slow, legs and legs per second.
CONTACT_HEIGHT, CONTACT_SPEED = 0.04, 0.3

# Names of joints without side, in lower case and letters only, first choices first.
ALIASES = {
    "Hips": "hips hip pelvis root",
    "UpLeg": "upleg upperleg thigh hip femur",
    "Leg": "leg loleg lowerleg shin calf knee tibia",
    "Foot": "ankle foot",
    "ToeBase": "toebase toe toes ball",
    "Arm": "arm uparm upperarm humerus shldr shoulder",
    "ForeArm": "forearm loarm lowerarm elbow radius",
    "Hand": "wrist hand",
    "Head": "head",
}
FINGER_ALIASES = {finger: finger.lower() for finger in FINGERS} | {"Pinky": "pinky|little"}
SECTION = 2.5  # seconds that share a passage's name
PARTS = {"metacarpal": 1, "proximal": 1, "intermediate": 2, "distal": 3}


@dataclass(frozen=True)
class Bvh:
    """A parsed file: joints, parents first, and their world rotations since the rest pose."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Array  # [J, 3] from the parent at rest, units and axes of the file
    rotations: Array  # [F, J, 3, 3] world, axes of the file
    root: Array  # [F, 3] position of the first joint
    frame_time: float  # seconds

    def positions(self, rotations: Array, root: Array) -> Array:
        """Joints ``[..., J, 3]`` for world rotations ``[..., J, 3, 3]``."""
        p = np.zeros((*root.shape[:-1], len(self.names), 3))
        p[..., 0, :] = root
        for j, parent in enumerate(self.parents[1:], 1):
            p[..., j, :] = p[..., parent, :] + rotations[..., parent, :, :] @ self.offsets[j]
        return p


def read_bvh(path: Path) -> Bvh:
    """Reads a BVH file.

    Raises:
        DataError: when it cannot be read, or is not a whole BVH file.
    """
    try:
        words = path.read_text(errors="replace").split()
    except OSError as error:
        raise DataError(f"{path} cannot be read: {error.strerror}; give a .bvh file") from error
    try:
        return _parse(words)
    except (ValueError, IndexError, StopIteration) as error:
        reason = error if isinstance(error, ValueError) else "it ends early"
        raise DataError(f"{path} is no whole BVH file ({reason}): export it again") from error


def _parse(words: list[str]) -> Bvh:
    if words[:1] != ["HIERARCHY"] or "MOTION" not in words:
        raise ValueError("HIERARCHY and MOTION are expected")
    names: list[str] = []
    parents: list[int] = []
    offsets: list[Array] = []
    channels: list[list[str]] = []
    open_joints: list[int] = []
    split = words.index("MOTION")
    tree = iter(words[1:split])
    for word in tree:
        if word in ("ROOT", "JOINT", "End"):
            names.append(next(tree) + " end" * (word == "End"))
            parents.append(open_joints[-1] if open_joints else -1)
            channels.append([])
            offsets.append(np.zeros(3))
            open_joints.append(len(names) - 1)
            while (word := next(tree)) != "{":
                names[-1] += " " + word
        elif word == "OFFSET":
            offsets[open_joints[-1]] = np.array([float(next(tree)) for _ in range(3)])
        elif word == "CHANNELS":
            channels[open_joints[-1]] = [next(tree) for _ in range(int(next(tree)))]
        elif word == "}":
            open_joints.pop()
    head, numbers = words[split + 1 : split + 6], words[split + 6 :]
    if head[0] != "Frames:" or head[2:4] != ["Frame", "Time:"]:
        raise ValueError("'Frames:' and 'Frame Time:' are expected after MOTION")
    frames, frame_time, columns = int(head[1]), float(head[4]), sum(len(c) for c in channels)
    if frames < 1 or not frame_time > 0 or len(numbers) != frames * columns:
        raise ValueError(
            f"{frames} frames of {columns} numbers, {frame_time:g} s apart, are announced, "
            f"{len(numbers)} numbers found"
        )
    values = np.array(numbers, dtype=float).reshape(frames, columns)
    if not (np.isfinite(values).all() and np.isfinite(offsets).all()):
        raise ValueError("a number is not finite")
    rotations, root = np.empty((frames, len(names), 3, 3)), np.zeros((frames, 3))
    column = 0
    for j, parent in enumerate(parents):
        R = np.eye(3) if parent < 0 else rotations[:, parent]
        for channel in channels[j]:
            axis = "XYZ".index(channel[0].upper())
            if channel.lower().endswith("rotation"):
                R = R @ rotation(np.radians(values[:, column, None]) * np.eye(3)[axis])
            elif parent < 0:  # other joints keep their offsets: bones do not change length
                root[:, axis] = values[:, column]
            column += 1
        rotations[:, j] = R
    return Bvh(tuple(names), tuple(parents), np.array(offsets), rotations, root, frame_time)


def known_joints(names: tuple[str, ...]) -> dict[str, int]:
    """Mixamo's bone name → index, for joints named as by Mixamo, MakeHuman, CMU, Blender, ….

    Spine, neck and collarbones are not among them: the tree says where they are.
    """
    found: dict[str, tuple[int, int]] = {}
    for j, name in enumerate(names):
        if name.startswith("__") or name.endswith(" end"):  # MakeHuman's helpers; end sites
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
        sided, rest = [match[1]], match[2]
        if not _stem(rest, True)[0]:
            sided, rest = [], stem
        stem = rest
    bone, rank = _stem(re.sub(r"^(mixamorig|j?bip)\d*(c(?=hips|head))?", "", stem), bool(sided))
    side = {"l": "Left", "r": "Right"}[sided[0][0]] if sided else ""
    return side + bone if bone else "", rank


def _stem(stem: str, sided: bool) -> tuple[str, int]:
    plain = stem.rstrip("0123456789")
    for bone, aliases in ALIASES.items():
        if plain in aliases.split() and sided != (bone in ("Hips", "Head")):
            return bone, aliases.split().index(plain)
    for finger, alias in FINGER_ALIASES.items():
        match = re.fullmatch(rf"(?:hand|f)?(?:{alias})(?:finger)?0?(\d?)({'|'.join(PARTS)})?", stem)
        if match and sided:
            return f"Hand{finger}{match[1] or PARTS.get(match[2], 1)}", 0
    return "", 0


class BvhMotion:
    """A BVH file's motion on a character, at any times; after its end the last frame stays.

    The person faces -Y in the first frame. A motion within `ROOM` of the middle of its path stays
    as recorded. Of a longer one, only what is faster than the smoothed path is kept, so that the
    person stays near the origin and walks as on a treadmill: its feet slide backwards. Where a
    foot rests in the remaining motion, it is held in place. One foot is on the floor except in
    jumps, which lose `HOVER`.

    Args:
        character: the subject. What its rig or the file lacks rests on its parent.
        path: a BVH file of a person, joints named as by Mixamo, MakeHuman, CMU, Blender, VRM, ….
        seed: of the blinks.

    Raises:
        DataError: when the file is not a whole BVH file, or a joint of the limbs is not found.
    """

    def __init__(self, character: Character, path: Path, seed: int = 0) -> None:
        self.rig, self.seed, self.name = Rig(character), seed, path.stem
        bvh = read_bvh(path)
        self.duration = len(bvh.root) * bvh.frame_time
        self._times = np.arange(len(bvh.root), dtype=np.float64) * bvh.frame_time
        standard = standard_motion(bvh, path)
        self._turns, joint = standard.turns, self.rig.joint
        offset = (joint["LeftUpLeg"] + joint["RightUpLeg"]) / 2 - joint["Hips"]
        thighs = (standard.joints["LeftUpLeg"] + standard.joints["RightUpLeg"]) / 2
        self._hips = thighs * self.rig.leg / standard.leg - self._turns["Hips"] @ offset
        self._settle(bvh.frame_time)

    def _settle(self, step: float) -> None:
        """Moves the hips near the origin and to the floor, and finds the ankles' targets."""
        hips, leg = self._hips, self.rig.leg
        pose = self._pose(self._turns, hips)
        lows = [pose.lowest(side) for side in SIDES]
        floor = floor_under(np.minimum(*lows), leg, step)
        shift = np.column_stack([-drift(hips[:, :2], step), -floor])
        self._hips, self._ankles = hips + shift, []
        for side, low in zip(SIDES, lows, strict=True):
            toe = side + "ToeBase" if side + "ToeBase" in self.rig.index else side + "Foot"
            ball = (pose.position(toe) + shift)[:, :2]
            ankle = pose.position(side + "Foot") + shift
            ankle[:, 2] += (floor - low).clip(0)
            ankle[:, :2] += _held(ball, low - floor < CONTACT_HEIGHT * leg, leg, step)
            self._ankles.append(ankle)

    def _pose(self, turns: dict[str, Array], hips: Array) -> Pose:
        pose = Pose(self.rig, hips)
        for bone, turn in turns.items():
            pose.set_turn(bone, turn)
        for side in SIDES:
            pose.set_hand(side, turns[side + "Hand"])
        return pose

    def at(self, times: Array) -> Motion:
        """The poses at times ``[F]``, seconds in [0, `duration`]."""
        times = times.clip(0, self._times[-1])

        def between_frames(values: Array) -> Array:
            return np.stack([np.interp(times, self._times, x) for x in values.T], axis=1)

        turns = {
            bone: _interpolated(turn, self._times, times) for bone, turn in self._turns.items()
        }
        pose = self._pose(turns, between_frames(self._hips))
        ankles = [between_frames(ankle) for ankle in self._ankles]
        knees = []
        for side in SIDES:
            hip, knee, ankle = (pose.position(side + bone) for bone in LEG)
            ahead = pose.turn(side + "UpLeg") @ (0.0, -1.0, 0.0)
            knees.append(knee - (hip + ankle) / 2 + 0.05 * self.rig.leg * ahead)
        pose.lower_hips(ankles)
        for side, ankle, pole in zip(SIDES, ankles, knees, strict=True):
            pose.reach(side, LEG, ankle, pole)
        sections = (times // SECTION).astype(int)
        blink = blinks(times, self.duration, self.seed)
        return pose.motion(blink, tuple(f"{self.name} {k}" for k in sections))


@dataclass(frozen=True)
class StandardMotion:
    """A file's motion in standard axes, starting towards -Y; by Mixamo's bone name."""

    turns: dict[str, Array]  # [F, 3, 3]
    joints: dict[str, Array]  # [F, 3] positions, units of the file
    leg: float  # the legs' length at rest, units of the file
    up: str  # the axis of the file that points up, e.g. "y"


def standard_motion(bvh: Bvh, path: Path) -> StandardMotion:
    """The motion of a tree of joints on the bones that people have.

    Raises:
        DataError: when a joint of the limbs is not found.
    """
    known = {"Hips": 0} | known_joints(bvh.names)
    if missing := [bone for bone in REQUIRED if bone not in known]:
        names = [name for name in bvh.names if not name.endswith(" end")]
        raise DataError(
            f"{path}: no joint found for {', '.join(missing)} among {', '.join(names)}; name the "
            f"joints as Mixamo does (LeftUpLeg, LeftLeg, LeftFoot, LeftArm, LeftForeArm, …)"
        )
    unturned = np.broadcast_to(np.eye(3), (len(bvh.names), 3, 3))
    rest = bvh.positions(unturned, np.zeros(3))
    thighs = rest[known["LeftUpLeg"]] + rest[known["RightUpLeg"]]
    height = thighs - rest[known["LeftFoot"]] - rest[known["RightFoot"]]
    up = np.eye(3)[np.abs(height).argmax()] * np.sign(height[np.abs(height).argmax()])
    left = rest[known["LeftUpLeg"]] - rest[known["RightUpLeg"]]
    left = unit(left - (left @ up) * up)
    axes = np.stack([left, np.cross(up, left), up])
    for bone in list(known):
        ends = [j for j, parent in enumerate(bvh.parents) if parent == known[bone]]
        if re.search(r"Hand\D+[23]$", bone) and ends:
            known.setdefault(bone[:-1] + str(int(bone[-1]) + 1), ends[0])
    joint = {bone: axes @ rest[j] for bone, j in known.items()}
    R = axes @ bvh.rotations @ axes.T
    ahead = R[0, known["Hips"]] @ (0.0, -1.0, 0.0)
    yaw = rotation(np.array([0, 0, -np.arctan2(ahead[0], -ahead[1])]))
    R, at_rest = yaw @ R, rest_turns(joint)
    turns = {bone: R[:, j] @ at_rest.get(bone, np.eye(3)) for bone, j in known.items()}
    turns |= _trunk(bvh, known, R)
    posed = bvh.positions(bvh.rotations, bvh.root) @ (yaw @ axes).T
    hip, knee, ankle = (joint["Left" + bone] for bone in LEG)
    leg = float(np.linalg.norm(hip - knee) + np.linalg.norm(knee - ankle))
    at = int(np.abs(up).argmax())
    name = ("-" if up[at] < 0 else "") + "xyz"[at]
    return StandardMotion(turns, {bone: posed[:, j] for bone, j in known.items()}, leg, name)


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


def _trunk(bvh: Bvh, known: dict[str, int], R: Array) -> dict[str, Array]:
    """Turns of spine, neck and collarbones, whatever their number, by their place in the tree."""

    def above(bone: str) -> list[int]:
        j = bvh.parents[known[bone]]
        line: list[int] = []
        while j >= 0:
            line, j = [j, *line], bvh.parents[j]
        return line

    left, right, legs = above("LeftArm"), above("RightArm"), above("LeftUpLeg")
    spine = [j for j in left if j in right and j not in (*legs, known["Hips"])]
    chain, turns = [R[:, j] for j in (known["Hips"], *spine)], {}
    for k, bone in enumerate(SPINE, 1):
        at = k * len(spine) / len(SPINE)
        low = int(at)
        turns[bone] = blend(chain[low], chain[min(low + 1, len(spine))], at - low)
    if "Head" in known:
        neck = [j for j in above("Head") if j not in left]
        turns["Neck"] = R[:, neck[0]] if neck else blend(chain[-1], R[:, known["Head"]], 0.5)
    for side, line, other in (("Left", left, right), ("Right", right, left)):
        if collar := [j for j in line if j not in other]:
            turns[side + "Shoulder"] = R[:, collar[-1]]
    return turns


def _held(ball: Array, low: NDArray[np.bool_], leg: float, step: float) -> Array:
    """``[F, 2]`` what keeps a foot in place while it rests, and fades between such times."""
    if len(ball) < 2:
        return np.zeros_like(ball)
    resting = low & (np.linalg.norm(np.gradient(ball, step, axis=0), axis=1) < CONTACT_SPEED * leg)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], resting, [0]])))
    frames, shift = [np.zeros(0, dtype=int)], [np.zeros((0, 2))]
    for begin, end in edges.reshape(-1, 2):
        run = ball[begin:end]
        if np.linalg.norm(np.ptp(run, axis=0)) < CONTACT_HEIGHT * 2 * leg:
            frames.append(np.arange(begin, end))
            shift.append(run.mean(axis=0) - run)
    at, values = np.concatenate(frames), np.concatenate(shift)
    if not len(at):
        return np.zeros_like(ball)
    return np.stack([np.interp(np.arange(len(ball)), at, v) for v in values.T], axis=1)


def _interpolated(turns: Array, known: Array, times: Array) -> Array:
    if len(known) == 1:
        return np.repeat(turns, len(times), axis=0)
    return np.asarray(Slerp(known, Rotation.from_matrix(turns))(times).as_matrix())
