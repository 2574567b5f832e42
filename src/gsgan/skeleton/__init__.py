"""From 3D joints to body points, bone frames, the 6D pose code and the drawn skeleton."""

from gsgan.skeleton.densify import Densify, Points
from gsgan.skeleton.draw import draw_skeleton
from gsgan.skeleton.face import face_code, in_head
from gsgan.skeleton.frames import BoneFrames, bone_frames, omega, root_of
from gsgan.skeleton.holistic import (
    HOLISTIC,
    MEDIAPIPE33_HANDS,
    TEMPLATES,
    named_template,
    template_of,
)
from gsgan.skeleton.rotation6d import rotation_from_6d, rotation_to_6d
from gsgan.skeleton.sanitise import complete_skeleton, limb_length_sum, sanitise
from gsgan.skeleton.template import MEDIAPIPE33, SkeletonTemplate

__all__ = [
    "HOLISTIC",
    "MEDIAPIPE33",
    "MEDIAPIPE33_HANDS",
    "TEMPLATES",
    "BoneFrames",
    "Densify",
    "Points",
    "SkeletonTemplate",
    "bone_frames",
    "complete_skeleton",
    "draw_skeleton",
    "face_code",
    "in_head",
    "limb_length_sum",
    "named_template",
    "omega",
    "root_of",
    "rotation_from_6d",
    "rotation_to_6d",
    "sanitise",
    "template_of",
]
