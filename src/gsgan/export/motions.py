"""The motion of a skinned body as other programs expect it: BVH, and glTF with skeleton and mesh.

Both have Y up; a person in the standard pose faces +Z. Joints have the body's own names, and their
axes are the world's in the rest pose, which is the body's.
"""

import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch.nn import functional

from gsgan.body import open_body
from gsgan.body.skinned import SkinnedBody, vertex_normals
from gsgan.data.formats.capture import read_capture
from gsgan.export.glb import (
    ARRAY_BUFFER,
    ELEMENT_ARRAY_BUFFER,
    GlbContent,
    to_y_up,
)
from gsgan.motion.rotations import Array
from gsgan.scene import BodyPose
from gsgan.utils.errors import DataError

CENTIMETRES = 100.0  # of BVH in a metre: most programs expect them
INFLUENCES = 4  # bones per vertex in glTF
FIRST_JOINT = 2  # its node in glTF, after the mesh and the world
LAST_BONE = 0.5  # length of an end site, share of the bone before


class BodyMotion(NamedTuple):
    """F poses of a body."""

    body: SkinnedBody
    poses: BodyPose
    fps: float
    up: str  # axis of the world, e.g. "z"


def read_captured(root: Path, smpl: str | None, fps: float) -> BodyMotion:
    """The body poses of a capture, with the fingers that hand landmarks show.

    Args:
        root: the folder of the capture.
        smpl: the user's body model file, for poses of SMPL.
        fps: frames per second if the capture does not have them.

    Raises:
        DataError: when the capture cannot be read, or has no body poses.
    """
    layout = read_capture(root, smpl=smpl)
    poses = layout.poses
    model = layout.meta.body
    body = None
    if model is not None:
        body = open_body(model.kind, model.file, model.betas)
    if poses is None or body is None:
        raise DataError(
            f"{root} has no body poses; python -m gsgan.fit data=capture data.root={root} makes "
            "them"
        )
    poses = poses.with_hands or poses
    theta = np.stack([poses.theta[frame] for frame in layout.frames])
    transl = np.stack([poses.transl[frame] for frame in layout.frames])
    return BodyMotion(
        body=body,
        poses=BodyPose(
            theta=torch.from_numpy(theta).float(),
            transl=torch.from_numpy(transl).float(),
        ),
        fps=layout.meta.fps or fps,
        up=layout.meta.up_axis,
    )


def bvh_text(motion: BodyMotion) -> str:
    """A BVH file: centimetres, joint rotations in the order Z, X, Y."""
    # The skeleton and the motion, turned to Y up.
    body = motion.body
    turn = to_y_up(motion.up)
    joints = CENTIMETRES * body.joints.double().numpy() @ turn.T
    angles = _euler(motion.poses.theta.double().numpy() @ turn.T)
    transl = motion.poses.transl.double().numpy() @ turn.T
    root = joints[0] + CENTIMETRES * transl

    # The tree, written joint by joint, children after their parent.
    lines = ["HIERARCHY"]
    order: list[int] = []

    def write(j: int, depth: int) -> None:
        pad = "\t" * depth
        parent = body.parents[j]
        offset = joints[j] - joints[parent] if parent >= 0 else np.zeros(3)
        kind = "JOINT" if parent >= 0 else "ROOT"
        channels = "3 Zrotation Xrotation Yrotation"
        if parent < 0:
            channels = (
                "6 Xposition Yposition Zposition Zrotation Xrotation Yrotation"
            )
        lines.append(f"{pad}{kind} {body.joint_names[j]}")
        lines.append(pad + "{")
        lines.append(f"{pad}\tOFFSET {_row(offset)}")
        lines.append(f"{pad}\tCHANNELS {channels}")
        order.append(j)
        children = [k for k, above in enumerate(body.parents) if above == j]
        for child in children:
            write(child, depth + 1)
        if not children:
            lines.append(f"{pad}\tEnd Site")
            lines.append(pad + "\t{")
            lines.append(f"{pad}\t\tOFFSET {_row(LAST_BONE * offset)}")
            lines.append(pad + "\t}")
        lines.append(pad + "}")

    write(0, 0)

    # A line of numbers for each frame.
    lines.append("MOTION")
    lines.append(f"Frames: {len(angles)}")
    lines.append(f"Frame Time: {1 / motion.fps:.8f}")
    for place, turned in zip(root, angles[:, order], strict=True):
        lines.append(f"{_row(place)} {_row(turned.ravel())}")
    return "\n".join(lines) + "\n"


def _row(values: Array) -> str:
    return " ".join(f"{value:.6f}" for value in values)


def _euler(axis_angle: Array) -> Array:
    """Degrees ``[F, J, 3]`` about z, x, y of axis-angle vectors ``[F, J, 3]``."""
    rotations = Rotation.from_rotvec(axis_angle.reshape(-1, 3))
    # At a gimbal lock one of many solutions is taken.
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        angles = rotations.as_euler("ZXY", degrees=True)
    return angles.reshape(axis_angle.shape)


def motion_glb(motion: BodyMotion) -> bytes:
    """A binary glTF file: the body's mesh on its skeleton, and one animation; metres."""
    body = motion.body
    joints = body.joints.numpy().astype("<f4")
    J = len(joints)
    content = GlbContent()
    primitive = _mesh(content, body)

    # Joints at rest have the world's axes, so that their inverse is a move; columns first.
    bind = np.tile(np.eye(4, dtype="<f4"), (J, 1, 1))
    bind[:, 3, :3] = -joints
    skin = {
        "joints": list(range(FIRST_JOINT, FIRST_JOINT + J)),
        "inverseBindMatrices": content.add(bind.reshape(J, 16)),
        "skeleton": FIRST_JOINT,
    }
    return content.file(
        {
            "scene": 0,
            "scenes": [{"nodes": [0, 1]}],
            "nodes": _nodes(motion),
            "meshes": [{"primitives": [primitive]}],
            "materials": [{"name": "body"}],
            "skins": [skin],
            "animations": [_animation(content, motion)],
        }
    )


def _mesh(content: GlbContent, body: SkinnedBody) -> dict[str, object]:
    """The body's mesh at rest, with the `INFLUENCES` largest weights of each vertex."""
    # Weights and bones of fewer columns are filled with zeros.
    weights, slots = body.bone_weight.double().topk(
        min(INFLUENCES, body.bone_weight.shape[1]), dim=1
    )
    bones = body.bone_index.gather(1, slots)
    bones = torch.where(weights > 0, bones, 0)
    missing = (0, INFLUENCES - weights.shape[1])
    weights = functional.pad(weights / weights.sum(1, keepdim=True), missing)
    bones = functional.pad(bones, missing)

    # The attributes of vertices, then the faces.
    values = {
        "POSITION": body.vertices.numpy().astype("<f4"),
        "NORMAL": vertex_normals(body.vertices, body.faces)
        .numpy()
        .astype("<f4"),
        "JOINTS_0": bones.numpy().astype("<u2"),
        "WEIGHTS_0": weights.numpy().astype("<f4"),
    }
    attributes = {}
    for name, array in values.items():
        attributes[name] = content.add(array, ARRAY_BUFFER)
    corners = body.faces.reshape(-1, 1).numpy().astype("<u4")
    indices = content.add(corners, ELEMENT_ARRAY_BUFFER)
    return {"attributes": attributes, "indices": indices, "material": 0}


def _nodes(motion: BodyMotion) -> list[dict[str, object]]:
    """The mesh, the turn to Y up, then the joints at rest."""
    body = motion.body
    joints = body.joints.numpy().astype("<f4")
    turn = Rotation.from_matrix(to_y_up(motion.up)).as_quat().tolist()
    nodes: list[dict[str, object]] = [
        {"name": "body", "mesh": 0, "skin": 0},
        {"name": "world", "rotation": turn, "children": [FIRST_JOINT]},
    ]
    for j, name in enumerate(body.joint_names):
        # A joint's place is relative to its parent's.
        parent = body.parents[j]
        offset = joints[j] - joints[parent] if parent >= 0 else joints[j]
        node: dict[str, object] = {"name": name, "translation": offset.tolist()}
        children = []
        for child, above in enumerate(body.parents):
            if above == j:
                children.append(FIRST_JOINT + child)
        if children:
            node["children"] = children
        nodes.append(node)
    return nodes


def _animation(content: GlbContent, motion: BodyMotion) -> dict[str, object]:
    """Every joint turns, and the root moves too."""
    theta = motion.poses.theta.double().numpy()
    times = (np.arange(len(theta)) / motion.fps).astype("<f4")
    keys = content.add(times[:, None])

    # The root's translation, then the rotations of all joints.
    root = motion.body.joints[0].numpy().astype("<f4")
    moves = root + motion.poses.transl.numpy().astype("<f4")
    samplers = [{"input": keys, "output": content.add(moves)}]
    channels = [
        {"sampler": 0, "target": {"node": FIRST_JOINT, "path": "translation"}}
    ]
    for j in range(theta.shape[1]):
        quaternions = Rotation.from_rotvec(theta[:, j]).as_quat().astype("<f4")
        samplers.append({"input": keys, "output": content.add(quaternions)})
        target = {"node": FIRST_JOINT + j, "path": "rotation"}
        channels.append({"sampler": j + 1, "target": target})
    return {"name": "motion", "samplers": samplers, "channels": channels}
