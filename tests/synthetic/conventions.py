"""One motion as BVH files in the conventions of many tools."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gsgan.motion.asf import asf_of, read_amc
from gsgan.motion.character import Animation, Character
from gsgan.motion.rotations import between, rotation
from gsgan.motion.standard import find_joints

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
X_FORWARD = np.array(
    [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]
)  # Z up; the person faces +X
LIMBS = (
    "UpLeg",
    "Leg",
    "Foot",
    "ToeBase",
    "Shoulder",
    "Arm",
    "ForeArm",
    "Hand",
)


def write_bvh(
    path: Path,
    character: Character,
    motion: Animation,
    step: float,
    *,
    name: Callable[[str], str] = str,
    axes: np.ndarray | None = None,
    scale: float = 1.0,
    order: str = "ZXY",
    zero: Callable[[Character, np.ndarray], np.ndarray] | None = None,
    everywhere: bool = False,
    roots: Sequence[str] = (),
    ends: bool = True,
) -> Path:
    """Writes a motion as a BVH file.

    Args:
        path: of the file.
        character: whose rest pose the motion's rotations count from.
        motion: poses.
        step: seconds between frames.
        name: the file's name of a bone.
        axes: rows are the file's axes.
        scale: the file's units in a metre.
        order: of the Euler angles.
        zero: of the character and the file's axes: ``[J, 3, 3]`` takes each joint's axes in the
            file to the character's at rest; by default the zero pose is the rest pose.
        everywhere: position channels on every joint.
        roots: names of joints above the first bone, at the origin.
        ends: end sites; otherwise joints of their own, as some tools write.
    """
    B = np.eye(3) if axes is None else axes
    Z = (
        zero(character, B)
        if zero
        else np.tile(B.T, (len(character.bones), 1, 1))
    )
    bones = [*roots, *character.bones]
    parents = [
        *range(-1, len(roots) - 1),
        *(int(p) + len(roots) for p in character.parents),
    ]
    frames = len(motion.joints)
    extra = np.broadcast_to(np.eye(3), (frames, len(roots), 3, 3))
    world = np.concatenate([extra, B @ motion.rotations @ Z], axis=1)
    offsets = np.zeros((len(bones), 3))
    for j, parent in enumerate(character.parents):
        if parent >= 0:
            offset = character.joints[j] - character.joints[parent]
            offsets[len(roots) + j] = scale * Z[parent].T @ offset
    local = np.broadcast_to(offsets, (frames, *offsets.shape)).copy()
    local[:, len(roots)] = scale * motion.joints[:, 0] @ B.T
    lines, columns = ["HIERARCHY"], []

    def write(j: int, depth: int) -> None:
        pad, first = "\t" * depth, j <= len(roots)
        kind = "JOINT" if parents[j] >= 0 else "ROOT"
        label = bones[j] if j < len(roots) else name(bones[j])
        lines.extend([f"{pad}{kind} {label}", pad + "{"])
        lines.append(
            pad + "\tOFFSET " + " ".join(f"{x:.8f}" for x in offsets[j])
        )
        moves = (
            ["Xposition", "Yposition", "Zposition"]
            if everywhere or first
            else []
        )
        channels = [*moves, *(f"{a}rotation" for a in order)]
        lines.append(f"{pad}\tCHANNELS {len(channels)} {' '.join(channels)}")
        columns.append((j, bool(moves)))
        children = [k for k, p in enumerate(parents) if p == j]
        for k in children:
            write(k, depth + 1)
        if not children and ends:
            lines.extend(
                [
                    pad + "\tEnd Site",
                    pad + "\t{",
                    pad + "\t\tOFFSET 0 0 0.01",
                    pad + "\t}",
                ]
            )
        elif not children:
            columns.append((None, False))
            lines.extend(
                [
                    f"{pad}\tJOINT {label}_tip",
                    pad + "\t{",
                    pad + "\t\tOFFSET 0 0 0.01",
                ]
            )
            lines.extend(
                [
                    pad + "\t\tCHANNELS 3 Zrotation Xrotation Yrotation",
                    pad + "\t}",
                ]
            )
        lines.append(pad + "}")

    write(0, 0)
    lines += ["MOTION", f"Frames: {frames}", f"Frame Time: {step}"]
    for f in range(frames):
        row: list[float] = []
        for j, moves in columns:
            if j is None:
                row += [0.0, 0.0, 0.0]
                continue
            R = (
                world[f, j]
                if parents[j] < 0
                else world[f, parents[j]].T @ world[f, j]
            )
            row += list(local[f, j]) if moves else []
            row += list(Rotation.from_matrix(R).as_euler(order, degrees=True))
        lines.append(" ".join(f"{x:.8f}" for x in row))
    path.write_text("\n".join(lines) + "\n")
    return path


# -- recorded motions

CMU = {
    "root": "Hips",
    "lowerback": "Spine",
    "upperback": "Spine1",
    "thorax": "Spine2",
}
CMU |= {"lowerneck": "Neck", "upperneck": "Neck1", "head": "Head"}
CMU_SIDED = {"clavicle": "Shoulder", "lowerforearmtwist": "ForeArmTwist"}
CMU_SIDED |= {"fingers": "HandMiddle1", "thumb": "HandThumb1"}


@dataclass(frozen=True)
class Bones:
    """What `write_bvh` needs of a character."""

    bones: tuple[str, ...]
    parents: np.ndarray
    joints: np.ndarray


def recorded(path: Path) -> tuple[Bones, Animation]:
    """An AMC motion with Mixamo's bone names, Z up."""
    rig, metres = read_amc(path, asf_of(path))
    known = {j: bone for bone, j in find_joints(rig.names).items()}

    def bone(j: int) -> str:
        name, side = (
            rig.names[j],
            {"l": "Left", "r": "Right"}.get(rig.names[j][0], ""),
        )
        return (
            CMU.get(name)
            or (side + CMU_SIDED.get(name[1:], "")) * (name[1:] in CMU_SIDED)
            or (known.get(j, name))
        )

    def above(j: int) -> int:
        parent = rig.parents[j]
        return parent if parent < 0 or parent in kept else above(parent)

    kept = [
        j
        for j, n in enumerate(rig.names)
        if not n.endswith((" end", "hipjoint"))
    ]
    parents = [kept.index(above(j)) if above(j) >= 0 else -1 for j in kept]
    B = Y_UP.T
    moved = Animation(
        B @ rig.rotations[:, kept] @ B.T,
        metres * rig.pose()[:, kept] @ B.T,
        {},
        (),
    )
    rest = metres * rig.zero_pose()[kept] @ B.T
    return Bones(tuple(map(bone, kept)), np.array(parents), rest), moved


# -- zero poses: `zero` of `write_bvh`


def turned(
    character: Character, axes: np.ndarray, turns: dict[str, np.ndarray]
) -> np.ndarray:
    """The zero pose with bones turned by ``[3, 3]`` from the rest pose, and all below them."""
    A = np.tile(np.eye(3), (len(character.bones), 1, 1))
    for j, (bone, parent) in enumerate(
        zip(character.bones, character.parents, strict=True)
    ):
        A[j] = turns.get(bone, np.eye(3)) @ (
            A[parent] if parent >= 0 else np.eye(3)
        )
    return np.swapaxes(A, 1, 2) @ axes.T


def lowered(
    character: Character, axes: np.ndarray, degrees: float
) -> np.ndarray:
    """The arms ``degrees`` below the horizontal."""
    turn = {
        "Left": np.radians([0.0, degrees, 0]),
        "Right": np.radians([0.0, -degrees, 0]),
    }
    return turned(
        character, axes, {f"{s}Arm": rotation(x) for s, x in turn.items()}
    )


def seated(character: Character, axes: np.ndarray) -> np.ndarray:
    """Thighs forward, shins down: a zero pose that does not stand."""
    forward, back = (
        rotation(np.radians([-90.0, 0, 0])),
        rotation(np.radians([90.0, 0, 0])),
    )
    turns = {f"{side}UpLeg": forward for side in ("Left", "Right")}
    return turned(
        character,
        axes,
        turns | {f"{side}Leg": back for side in ("Left", "Right")},
    )


def along(character: Character, axis: int) -> np.ndarray:
    """Every bone along an axis of its joint, as in files of motion capture systems."""
    own = np.tile(np.eye(3), (len(character.bones), 1, 1))
    for j, parent in enumerate(character.parents):
        children = np.flatnonzero(character.parents == j)
        if len(children):
            here = character.joints[children].mean(0) - character.joints[j]
            own[j] = between(np.eye(3)[axis], here)
        elif parent >= 0:
            own[j] = own[parent]
    return own


def random(character: Character) -> np.ndarray:
    """Joints with axes of their own, of no order."""
    return Rotation.random(len(character.bones), rng=5).as_matrix()


# -- names


def _named(limbs: str, trunk: dict[str, str], form: Callable[[str, str], str]):
    parts = dict(zip(LIMBS, limbs.split(), strict=True))

    def name(bone: str) -> str:
        if bone in trunk:
            return trunk[bone]
        side = "Left" if bone.startswith("Left") else "Right"
        stem = bone.removeprefix(side)
        return form(side, parts.get(stem, stem))

    return name


def _trunk(names: str) -> dict[str, str]:
    keys = ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head")
    return dict(zip(keys, names.split(), strict=True))


NAMES = {
    "mixamo": lambda bone: "mixamorig:" + bone,
    "prefixed": lambda bone: "Character1_Ctrl:" + bone,
    "bandai_namco": _named(
        "UpperLeg LowerLeg Foot Toes Shoulder UpperArm LowerArm Hand",
        _trunk("Hips Spine Chest UpperChest Neck Head"),
        lambda side, part: f"{part}_{side[0]}",
    ),
    "rokoko": _named(
        "Thigh Shin Foot Toe Shoulder Arm ForeArm Hand",
        _trunk("Hips Spine1 Spine2 Spine3 Neck Head"),
        lambda side, part: side + part,
    ),
    "xsens": _named(
        "Hip Knee Ankle Toe Collar Shoulder Elbow Wrist",
        _trunk("Hips Chest Chest2 Chest3 Neck Head"),
        lambda side, part: side + part,
    ),
    "blender": _named(
        "thigh shin foot toe shoulder upper_arm forearm hand",
        _trunk("spine spine.001 spine.002 spine.003 spine.005 head"),
        lambda side, part: f"{part}.{side[0]}",
    ),
    "vrm": _named(
        "UpperLeg LowerLeg Foot ToeBase Shoulder UpperArm LowerArm Hand",
        {
            k: f"J_Bip_C_{v}"
            for k, v in _trunk("Hips Spine Chest UpperChest Neck Head").items()
        },
        lambda side, part: f"J_Bip_{side[0]}_{part}",
    ),
    "unreal": _named(
        "thigh calf foot ball clavicle upperarm lowerarm hand",
        _trunk("pelvis spine_01 spine_02 spine_03 neck_01 head"),
        lambda side, part: f"{part.lower()}_{side[0].lower()}",
    ),
    "character_creator": _named(
        "Thigh Calf Foot ToeBase Clavicle Upperarm Forearm Hand",
        {
            k: f"CC_Base_{v}"
            for k, v in _trunk(
                "Hip Waist Spine01 Spine02 NeckTwist01 Head"
            ).items()
        },
        lambda side, part: f"CC_Base_{side[0]}_{part}",
    ),
    "cmu": _named(
        "femur tibia foot toes clavicle humerus radius hand",
        _trunk("root lowerback upperback thorax lowerneck head"),
        lambda side, part: side[0].lower() + part.lower(),
    ),
}


def convention(names: str = "mixamo", **options: Any) -> dict[str, Any]:
    """How a tool writes: options of `write_bvh`; centimetres and y up if not given."""
    return {"name": NAMES[names], "axes": Y_UP, "scale": 100.0} | options


CONVENTIONS = {
    "t_pose": convention(),
    "a_pose_inches": convention(
        "cmu", scale=39.37, zero=lambda c, a: lowered(c, a, 45)
    ),
    "n_pose_metres": convention(
        "unreal",
        axes=np.eye(3),
        scale=1.0,
        order="XYZ",
        zero=lambda c, a: lowered(c, a, 85),
    ),
    "bones_along_x": convention(
        "bandai_namco",
        zero=lambda c, a: along(c, 0),
        everywhere=True,
        roots=("joint_Root",),
    ),
    "bones_along_y": convention(
        "blender",
        axes=np.eye(3),
        scale=1.0,
        order="YZX",
        zero=lambda c, a: along(c, 1),
    ),
    "joint_orients": convention(
        "rokoko", order="XZY", zero=lambda c, a: random(c)
    ),
    "x_forward": convention(
        "vrm", axes=X_FORWARD, scale=1.0, order="YXZ", everywhere=True
    ),
    "turned_by_the_root": convention(
        "xsens", order="ZYX", zero=lambda c, a: turned(c, np.eye(3), {})
    ),
    "seated": convention("prefixed", zero=seated, everywhere=True),
    "arms_20_degrees_down": convention(
        "character_creator", zero=lambda c, a: lowered(c, a, 20)
    ),
    "extra_roots_and_ends": convention(
        "unreal", roots=("World", "Armature"), ends=False
    ),
}
