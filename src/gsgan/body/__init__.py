"""Skinned bodies: linear blend skinning and the free body."""

from gsgan.body.free import Body, free_body, read_body
from gsgan.body.lbs import axis_angle_to_matrix, blend_transforms, forward_kinematics, skin

__all__ = [
    "Body",
    "axis_angle_to_matrix",
    "blend_transforms",
    "forward_kinematics",
    "free_body",
    "read_body",
    "skin",
]
