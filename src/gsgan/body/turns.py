"""Small turns of a body's joints and moves of its root, found through images."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gsgan.scene import BodyPose

# joints that are too small in an image to be found there
SMALL_JOINTS = ("finger", "toe")


def turn_scale(joint_names: Sequence[str], transl: float) -> Tensor:
    """``[bones + 1, 1]`` factors of parameters that share a learning rate: 1 for turns, 0 for
    those of fingers and toes, and ``transl`` for the root's move, the last row."""
    scale = torch.ones(len(joint_names) + 1, 1)
    scale[-1] = transl
    for bone, name in enumerate(joint_names):
        if name.startswith(SMALL_JOINTS):
            scale[bone] = 0
    return scale


def turn_joints(pose: BodyPose, moves: Tensor) -> BodyPose:
    """B poses changed by ``[B, bones + 1, 3]``: radians of each joint, and metres of the root."""
    theta = pose.theta + moves[:, :-1]
    transl = pose.transl + moves[:, -1]
    return replace(pose, theta=theta, transl=transl, bones=None)
