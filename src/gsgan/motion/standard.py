"""The motion of a rig from a file, in standard axes and on the bones that people have.

Convention: that of :mod:`gsgan.motion.rig`. A file's up axis and left side are found from its rest
pose, lengths follow from the legs.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from gsgan.motion.rig import FINGERS, LEG, REQUIRED, SPINE, rest_turns
from gsgan.motion.rotations import Array, blend, rotation, unit
from gsgan.utils.errors import DataError

HOVER = 0.06  # legs: feet this high above the lowest of a second stand on the floor; no jump
ROOM = 0.6  # metres from the origin that a motion may reach before its drift is subtracted
DRIFT_SECONDS = 0.5  # standard deviation of the smoothing that separates drift from sway
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
PARTS = {"metacarpal": 1, "proximal": 1, "intermediate": 2, "distal": 3}


def known_joints(names: tuple[str, ...]) -> dict[str, int]:
    """Mixamo's bone name → index, for joints named as by Mixamo, MakeHuman, CMU, Blender, ….

    Spine, neck and collarbones are not among them: they follow from the tree of joints.
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


@dataclass(frozen=True)
class RigMotion:
    """The motion of a rig as a file has it: joints, parents first, and their world rotations."""

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Array  # [J, 3] from the parent at rest, units and axes of the file
    rotations: Array  # [F, J, 3, 3] since the rest pose, axes of the file
    root: Array  # [F, 3] position of the first joint
    frame_time: float  # seconds

    def positions(self, rotations: Array, root: Array) -> Array:
        """Joints ``[..., J, 3]`` for world rotations ``[..., J, 3, 3]``."""
        p = np.zeros((*root.shape[:-1], len(self.names), 3))
        p[..., 0, :] = root
        for j, parent in enumerate(self.parents[1:], 1):
            p[..., j, :] = p[..., parent, :] + rotations[..., parent, :, :] @ self.offsets[j]
        return p


@dataclass(frozen=True)
class StandardMotion:
    """A file's motion in standard axes, starting towards -Y; by Mixamo's bone name."""

    turns: dict[str, Array]  # [F, 3, 3]
    joints: dict[str, Array]  # [F, 3] positions, units of the file
    leg: float  # the legs' length at rest, units of the file
    up: str  # the axis of the file that points up, e.g. "y"


def standard_motion(motion: RigMotion, path: Path) -> StandardMotion:
    """The motion of a tree of joints on the bones that people have.

    Raises:
        DataError: when a joint of the limbs is not found.
    """
    known = {"Hips": 0} | known_joints(motion.names)
    if missing := [bone for bone in REQUIRED if bone not in known]:
        names = [name for name in motion.names if not name.endswith(" end")]
        raise DataError(
            f"{path}: no joint found for {', '.join(missing)} among {', '.join(names)}; name the "
            f"joints as Mixamo does (LeftUpLeg, LeftLeg, LeftFoot, LeftArm, LeftForeArm, …)"
        )
    unturned = np.broadcast_to(np.eye(3), (len(motion.names), 3, 3))
    rest = motion.positions(unturned, np.zeros(3))
    thighs = rest[known["LeftUpLeg"]] + rest[known["RightUpLeg"]]
    height = thighs - rest[known["LeftFoot"]] - rest[known["RightFoot"]]
    up = np.eye(3)[np.abs(height).argmax()] * np.sign(height[np.abs(height).argmax()])
    left = rest[known["LeftUpLeg"]] - rest[known["RightUpLeg"]]
    left = unit(left - (left @ up) * up)
    axes = np.stack([left, np.cross(up, left), up])
    for bone in list(known):
        ends = [j for j, parent in enumerate(motion.parents) if parent == known[bone]]
        if re.search(r"Hand\D+[23]$", bone) and ends:
            known.setdefault(bone[:-1] + str(int(bone[-1]) + 1), ends[0])
    joint = {bone: axes @ rest[j] for bone, j in known.items()}
    R = axes @ motion.rotations @ axes.T
    ahead = R[0, known["Hips"]] @ (0.0, -1.0, 0.0)
    yaw = rotation(np.array([0, 0, -np.arctan2(ahead[0], -ahead[1])]))
    R, at_rest = yaw @ R, rest_turns(joint)
    turns = {bone: R[:, j] @ at_rest.get(bone, np.eye(3)) for bone, j in known.items()}
    turns |= _trunk(motion, known, R)
    posed = motion.positions(motion.rotations, motion.root) @ (yaw @ axes).T
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


def _trunk(motion: RigMotion, known: dict[str, int], R: Array) -> dict[str, Array]:
    """Turns of spine, neck and collarbones, whatever their number, by their place in the tree."""

    def above(bone: str) -> list[int]:
        j = motion.parents[known[bone]]
        line: list[int] = []
        while j >= 0:
            line, j = [j, *line], motion.parents[j]
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
