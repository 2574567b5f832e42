"""One motion as glTF files in the conventions of many tools."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
from conventions import NAMES, random
from scipy.spatial.transform import Rotation
from tiny_glb import GlbWriter

from gsgan.motion.character import Animation, Character
from gsgan.motion.rotations import rotation

Z_TO_Y_UP = (-np.sqrt(0.5), 0, 0, np.sqrt(0.5))  # quaternion x y z w
VRM_LIMBS = {
    "UpLeg": "UpperLeg",
    "Leg": "LowerLeg",
    "Foot": "Foot",
    "ToeBase": "Toes",
    "Shoulder": "Shoulder",
    "Arm": "UpperArm",
    "ForeArm": "LowerArm",
    "Hand": "Hand",
}
VRM_TRUNK = {
    "Hips": "hips",
    "Spine": "spine",
    "Spine1": "chest",
    "Spine2": "upperChest",
    "Neck": "neck",
    "Head": "head",
}
VRM_THUMB = ("Metacarpal", "Proximal", "Distal")
VRM_FINGER = ("Proximal", "Intermediate", "Distal")


def write_gltf(
    path: Path,
    character: Character,
    motion: Animation,
    step: float,
    *,
    name: Any = str,
    own: np.ndarray | None = None,
    pose: np.ndarray | None = None,
    scale: float = 1.0,
    extension: str = "",
    skin: bool = True,
    interpolation: str = "LINEAR",
    shorts: bool = False,
    every_channel: bool = True,
) -> Path:
    """Writes a motion as a .glb, or as a .gltf with a .bin file beside it.

    Args:
        path: of the file.
        character: whose rest pose the motion's rotations count from.
        motion: poses.
        step: seconds between keys.
        name: the file's name of a bone.
        own: ``[J, 3, 3]`` axes of the joints in the character's rest pose.
        pose: ``[J, 3, 3]`` world rotations of the file's rest pose since the character's.
        scale: of the node above the skeleton, which turns it to y up.
        extension: of VRM that maps the nodes.
        skin: whether the joints belong to a skin.
        interpolation: of all keys.
        shorts: quaternions as normalised 16-bit integers.
        every_channel: also of properties that do not change.
    """
    glb = GlbWriter()
    bones = character.bones
    own = np.tile(np.eye(3), (len(bones), 1, 1)) if own is None else own
    pose = np.tile(np.eye(3), (len(bones), 1, 1)) if pose is None else pose

    # The rest pose is one more frame.
    joints = np.zeros((len(bones), 3))
    joints[0] = character.joints[0]
    for j, parent in enumerate(character.parents):
        if parent >= 0:
            offset = character.joints[j] - character.joints[parent]
            joints[j] = joints[parent] + pose[parent] @ offset
    world = np.concatenate([motion.rotations, pose[None]]) @ own
    places = np.concatenate([motion.joints, joints[None]]) / scale

    glb.doc.nodes.append(
        pygltflib.Node(
            name="Armature",
            rotation=list(Z_TO_Y_UP),
            scale=[scale] * 3,
            children=[1],
        )
    )
    glb.doc.scenes.append(pygltflib.Scene(nodes=[0]))
    times = glb.accessor(
        (2.5 + step * np.arange(len(motion.joints))).astype("f4")[:, None],
        "SCALAR",
    )
    animation = pygltflib.Animation(name="moves")
    for j, (bone, parent) in enumerate(
        zip(bones, character.parents, strict=True)
    ):
        turns, moves = world[:, j], places[:, j]
        if parent >= 0:
            above = np.swapaxes(world[:, parent], 1, 2)
            moves = (above @ (moves - places[:, parent])[..., None])[..., 0]
            turns = above @ turns
            glb.doc.nodes[1 + parent].children.append(1 + j)
        quaternions = Rotation.from_matrix(turns).as_quat()
        node = pygltflib.Node(
            name=name(bone),
            translation=moves[-1].tolist(),
            rotation=quaternions[-1].tolist(),
        )
        glb.doc.nodes.append(node)
        for kind, values in (("translation", moves), ("rotation", quaternions)):
            if not every_channel and np.allclose(values, values[-1], atol=1e-9):
                continue
            add_channel(
                glb,
                animation,
                1 + j,
                kind,
                times,
                values[:-1],
                interpolation,
                shorts,
            )
    glb.doc.animations.append(animation)
    if skin:
        numbers = list(range(1, 1 + len(bones)))
        glb.doc.skins.append(pygltflib.Skin(joints=numbers))
    if extension:
        glb.doc.extensions[extension] = {
            "humanoid": {"humanBones": vrm_bones(bones, extension)}
        }
    return save(glb, path)


def add_channel(
    glb: GlbWriter,
    animation: pygltflib.Animation,
    node: int,
    kind: str,
    times: int,
    values: np.ndarray,
    interpolation: str = "LINEAR",
    shorts: bool = False,
) -> None:
    """Keys of a node's property; cubic splines get tangents of differences."""
    if interpolation == "CUBICSPLINE" and values.ndim == 2:
        tangents = (
            np.gradient(values, axis=0) if len(values) > 1 else 0 * values
        )
        values = np.stack([tangents, values, tangents], axis=1)
    more = {}
    rows = values.reshape(-1, values.shape[-1])
    if shorts and kind == "rotation":
        rows = np.rint(rows * 32767).astype("i2")
        more["normalized"] = True
    else:
        rows = rows.astype("f4")
    animation.samplers.append(
        pygltflib.AnimationSampler(
            input=times,
            output=glb.accessor(
                rows, {3: "VEC3", 4: "VEC4"}[rows.shape[1]], **more
            ),
            interpolation=interpolation,
        )
    )
    target = pygltflib.AnimationChannelTarget(node=node, path=kind)
    animation.channels.append(
        pygltflib.AnimationChannel(
            sampler=len(animation.samplers) - 1, target=target
        )
    )


def save(glb: GlbWriter, path: Path) -> Path:
    """Writes a .glb, or a .gltf with its buffer in a file of its own."""
    if path.suffix != ".gltf":
        return glb.write(path)
    path.with_suffix(".bin").write_bytes(glb.blob)
    glb.doc.buffers = [
        pygltflib.Buffer(byteLength=len(glb.blob), uri=path.stem + ".bin")
    ]
    path.write_text(glb.doc.to_json())
    return path


def vrm_bones(bones: tuple[str, ...], extension: str) -> Any:
    """The map of VRM 0 or 1 from bones to nodes."""
    pairs = []
    for j, bone in enumerate(bones):
        side = "left" if bone.startswith("Left") else "right"
        limb = VRM_LIMBS.get(bone.removeprefix(side.title()))
        finger = re.fullmatch(r"(Left|Right)Hand(\w+)([123])", bone)
        if finger:
            thumb = finger[2] == "Thumb" and extension != "VRM"
            segments = VRM_THUMB if thumb else VRM_FINGER
            stem = "Little" if finger[2] == "Pinky" else finger[2]
            limb = stem + segments[int(finger[3]) - 1]
        found = VRM_TRUNK.get(bone) or (limb and side + limb)
        if found:
            pairs.append((found, 1 + j))
    if extension == "VRM":
        return [{"bone": bone, "node": node} for bone, node in pairs]
    return {bone: {"node": node} for bone, node in pairs}


def lowered_arms(character: Character, degrees: float) -> np.ndarray:
    """World rotations ``[J, 3, 3]`` of a rest pose with arms below the horizontal."""
    pose = np.tile(np.eye(3), (len(character.bones), 1, 1))
    for j, (bone, parent) in enumerate(
        zip(character.bones, character.parents, strict=True)
    ):
        if parent >= 0:
            pose[j] = pose[parent]
        if bone in ("LeftArm", "RightArm"):
            sign = 1 if bone == "LeftArm" else -1
            pose[j] = rotation(np.radians([0.0, sign * degrees, 0]))
    return pose


def scrambled(bone: str) -> str:
    """A name that says nothing of the bone."""
    return "node_" + bone.encode().hex()


CONVENTIONS = {
    "mixamo": lambda c: {"name": NAMES["mixamo"], "scale": 0.01},
    "blender_a_pose": lambda c: {
        "name": NAMES["blender"],
        "own": random(c),
        "pose": lowered_arms(c, 45),
    },
    "unreal_inches": lambda c: {
        "name": NAMES["unreal"],
        "scale": 0.0254,
        "interpolation": "STEP",
    },
    "cubic": lambda c: {
        "name": NAMES["rokoko"],
        "interpolation": "CUBICSPLINE",
    },
    "few_channels": lambda c: {"name": NAMES["cmu"], "every_channel": False},
    "without_skin": lambda c: {"name": NAMES["bandai_namco"], "skin": False},
    "vrm_0": lambda c: {"name": scrambled, "extension": "VRM"},
    "vrm_1": lambda c: {"name": scrambled, "extension": "VRMC_vrm"},
    "vrma": lambda c: {
        "name": scrambled,
        "extension": "VRMC_vrm_animation",
        "skin": False,
        "own": random(c),
    },
    "shorts": lambda c: {"name": NAMES["mixamo"], "shorts": True},
}
"""By name: the options of `write_gltf` for a character."""
