"""Skinned bodies: linear blend skinning, the free body, and the user's SMPL files.

Body models of the SMPL family are in `gsgan.body.smpl`.
"""

from gsgan.body.free import Body, free_body, read_body
from gsgan.body.lbs import (
    axis_angle_to_matrix,
    blend_transforms,
    check_weights,
    forward_kinematics,
    skin,
)
from gsgan.body.shape import open_body
from gsgan.body.skinned import SkinnedBody

__all__ = [
    "Body",
    "SkinnedBody",
    "axis_angle_to_matrix",
    "blend_transforms",
    "check_weights",
    "forward_kinematics",
    "free_body",
    "open_body",
    "read_body",
    "skin",
]
