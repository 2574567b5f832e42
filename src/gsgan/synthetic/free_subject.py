"""The free body as a character: a test scene whose exact body pose is known.

Its motion is that of any other character; its file has `body_pose.npz` beside the landmarks.
"""

import re

import numpy as np
import torch

from gsgan.body.free import free_body
from gsgan.body.skinned import vertex_normals
from gsgan.motion.character import Animation, Character, Surface
from gsgan.motion.rig import FINGERS
from gsgan.motion.rotations import axis_angle
from gsgan.scene import BodyPose

# Mixamo's names of the free body's joints; other joints keep their names and follow their parents.
TRUNK_BONES = {
    "root": "Hips",
    "spine05": "Spine",
    "spine03": "Spine1",
    "spine01": "Spine2",
    "neck01": "Neck",
    "head": "Head",
}
SIDED_BONES = {
    "clavicle": "Shoulder",
    "upperarm01": "Arm",
    "lowerarm01": "ForeArm",
    "wrist": "Hand",
    "upperleg01": "UpLeg",
    "lowerleg01": "Leg",
    "foot": "Foot",
    "toe1-1": "ToeBase",
}
# sRGB colours of the surfaces.
COLOURS = (
    (214, 160, 128),  # skin
    (70, 48, 34),  # hair
    (235, 235, 230),  # eyes
    (52, 110, 168),  # shirt
    (64, 66, 88),  # trousers
    (150, 60, 48),  # shoes
)


def mixamo_name(joint: str) -> str:
    """Mixamo's name of a joint of the free body."""
    if joint in TRUNK_BONES:
        return TRUNK_BONES[joint]

    # Other names end with their side.
    part, _, letter = joint.partition(".")
    side = {"L": "Left", "R": "Right"}.get(letter, "")
    if part in SIDED_BONES:
        return side + SIDED_BONES[part]
    match = re.fullmatch(r"finger(\d)-(\d)", part)
    if match:
        finger = FINGERS[int(match[1]) - 1]
        return f"{side}Hand{finger}{match[2]}"
    return joint


def free_character() -> Character:
    """The free body with one colour per material."""
    body = free_body()
    faces = body.faces.numpy()
    vertices = body.vertices.double().numpy()

    # Landmarks are not anchored here: their arrays are empty.
    none = np.zeros(0, dtype=np.int64)

    # Each surface is a texture of one opaque texel.
    surfaces = []
    for name, colour in zip(body.surface_names, COLOURS, strict=True):
        texel = np.array([[[*colour, 255]]], np.uint8)
        surfaces.append(Surface(name, texel))

    # The arrays of the body, with bones named as the motions expect them.
    return Character(
        name="free_body",
        vertices=vertices,
        normals=vertex_normals(body.vertices.double(), body.faces).numpy(),
        uv=np.zeros((len(vertices), 2)),
        faces=faces,
        material=body.face_surface.numpy(),
        labels=body.face_labels.numpy(),
        label_names=body.label_names,
        surfaces=tuple(surfaces),
        bones=tuple(map(mixamo_name, body.joint_names)),
        parents=np.array(body.parents),
        joints=body.joints.double().numpy(),
        bone_index=body.bone_index.numpy(),
        bone_weight=body.bone_weight.double().numpy(),
        shapes={},
        anchor_names=(),
        anchor_joint=none,
        anchor_vertex=none,
    )


def free_pose(motion: Animation) -> BodyPose:
    """The free body's pose in every frame of the animation of `free_character`."""
    body = free_body()

    # The rotation of each bone relative to its parent; roots keep theirs.
    R = motion.rotations
    parents = np.array(body.parents)
    relative = np.swapaxes(R[:, parents], -1, -2) @ R
    is_root = (parents < 0)[:, None, None]
    local = np.where(is_root, R, relative)

    # The translation is that of the first joint from its place at rest.
    transl = motion.joints[:, 0] - body.joints[0].double().numpy()
    return BodyPose(
        theta=torch.from_numpy(axis_angle(local)).float(),
        transl=torch.from_numpy(transl).float(),
    )
