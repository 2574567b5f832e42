"""Skeleton definitions: joint names, bones, rest shape. Constants only, no tensors.

Body axes are x = the subject's left, y = up, z = out of the chest (right-handed), in metres. Left
and right are the person's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

Vector = tuple[float, float, float]
Edge = tuple[int, int]

PELVIS = 0
CHEST = 1
HEAD = 2
"""Positions of the hub frames; those of palms follow, then those of limbs, see `n_hubs`."""
N_HUBS = 3


@dataclass(frozen=True, eq=False)
class SkeletonTemplate:
    """Joints, bones and rest shape of one kind of skeleton.

    Compared and hashed by identity, so that it can be the key of cached tensors. Left joints come
    before right ones.

    Source: ours; the paper names MediaPipe Pose and Algorithm 1.
    """

    names: tuple[str, ...]  # of the J joints
    edges: tuple[Edge, ...]  # the connections that the landmark detector draws
    # (parent joint, child joint) of the bones with a cylinder
    limbs: tuple[Edge, ...]
    # per limb, the frame that its own is relative to: 0 pelvis, 1 chest, 2 head, 3 + h palm h,
    # n_hubs + l limb l
    limb_parents: tuple[int, ...]
    # per limb, unit, in its parent's frame; not the rest pose: chosen so that the opposite
    # direction, where the swing is undefined, is out of reach
    rest_directions: tuple[Vector, ...]
    # J points of an A-pose on the ground y = 0
    rest_positions: tuple[Vector, ...]
    stature: float  # metres, sole to crown of the rest pose
    # pairs of joints, left and right
    shoulders: Edge
    hips: Edge
    ears: Edge
    eyes: Edge
    nose: int
    face: tuple[int, ...]  # joints inside the head's sphere
    # per joint, its counterpart (itself on the midline)
    mirror: tuple[int, ...]
    # (name, segments) of drawn channels
    draw_groups: tuple[tuple[str, tuple[Edge, ...]], ...]
    # the edges connected to one component, for message passing
    gnn_edges: tuple[Edge, ...]
    # wrist, index's and little finger's knuckles
    palms: tuple[tuple[int, int, int], ...] = ()
    fingers: tuple[int, ...] = ()  # limbs that are bones of hands
    # limbs without a cylinder: another limb lies there
    bare: tuple[int, ...] = ()
    # the last joints: landmarks of a face, which rest on the head
    expression: tuple[int, ...] = ()

    @property
    def torso(self) -> tuple[int, int, int, int]:
        """The joints of the trunk: left and right shoulder, left and right hip."""
        return (*self.shoulders, *self.hips)

    @property
    def head(self) -> tuple[int, ...]:
        """Joints that turn and move with the head alone: left and right ear and eye, the nose."""
        return (*self.ears, *self.eyes, self.nose)

    @property
    def n_hubs(self) -> int:
        """Number of frames before the limbs': pelvis, chest, head and palms."""
        return N_HUBS + len(self.palms)

    @property
    def measured(self) -> tuple[int, ...]:
        """Limbs whose lengths measure the subject's size: all but those of hands."""
        left_out = {*self.fingers, *self.bare}
        return tuple(i for i in range(len(self.limbs)) if i not in left_out)

    @property
    def levels(self) -> tuple[tuple[int, ...], ...]:
        """Limbs by depth: every limb's parent frame is a hub or in an earlier level.

        A palm is as deep as the limbs that end at its knuckles.
        """
        # Parents come before their limbs, so their depth is known.
        depth: dict[int, int] = {}
        for limb, parent in enumerate(self.limb_parents):
            if parent < N_HUBS:
                depth[limb] = 0
            elif parent < self.n_hubs:
                _, knuckle, _ = self.palms[parent - N_HUBS]
                depth[limb] = depth[self.incoming[knuckle]] + 1
            else:
                depth[limb] = depth[parent - self.n_hubs] + 1

        # Limbs of the same depth, which are computed together.
        levels: list[list[int]] = [[] for _ in range(max(depth.values()) + 1)]
        for limb, level in depth.items():
            levels[level].append(limb)
        return tuple(map(tuple, levels))

    @property
    def incoming(self) -> dict[int, int]:
        """Per joint at the end of a bone, the first limb that ends there."""
        edges: dict[int, int] = {}
        for limb, (_, child) in enumerate(self.limbs):
            if child not in self.torso:
                edges.setdefault(child, limb)
        return edges

    @property
    def limb_length_sum(self) -> float:
        """Metres: the sum of limb lengths of the rest pose, the counterpart of ``h_body``."""
        rest = np.asarray(self.rest_positions)
        # The same limbs as in `limb_length_sum` of a skeleton.
        total = 0.0
        for limb in self.measured:
            start, end = self.limbs[limb]
            total += float(np.linalg.norm(rest[end] - rest[start]))
        return total

    def stature_of(self, limb_length_sum: float) -> float:
        """Metres: the stature of a subject whose limbs have this sum of lengths."""
        return limb_length_sum * self.stature / self.limb_length_sum

    @property
    def rest_torso(self) -> Vector:
        """Metres: edges (left-right, up, front) of the trunk's box in the rest pose."""
        # As wide as shoulders or hips, as high as the spine, half as deep as wide.
        l_sh, r_sh, l_hip, r_hip = np.asarray(self.rest_positions)[
            list(self.torso)
        ]
        width = float(
            max(np.linalg.norm(l_sh - r_sh), np.linalg.norm(l_hip - r_hip))
        )
        height = float(np.linalg.norm((l_sh + r_sh - l_hip - r_hip) / 2))
        return width, height, width / 2

    def with_face(self, at_rest: Sequence[Vector]) -> SkeletonTemplate:
        """A copy with another person's face at rest, as `gsgan.skeleton.in_head` gives it."""
        rest = np.asarray(self.rest_positions)
        moved = np.asarray(at_rest) + rest[list(self.head)].mean(0)
        kept = self.rest_positions[: -len(self.expression)]
        face = [(x, y, z) for x, y, z in moved.tolist()]
        return replace(self, rest_positions=(*kept, *face))


def _unit(x: float, y: float, z: float) -> Vector:
    norm = (x * x + y * y + z * z) ** 0.5
    return (x / norm, y / norm, z / norm)


def _mirror(v: Vector) -> Vector:
    return (-v[0], v[1], v[2])


def _across(axis: Vector, direction: Vector) -> Vector:
    """The part of ``axis`` orthogonal to the unit ``direction``, normalised."""
    # The part along the direction is subtracted.
    along = sum(a * d for a, d in zip(axis, direction, strict=True))
    return _unit(*(a - along * d for a, d in zip(axis, direction, strict=True)))


# MediaPipe's 33 joints, and the edges and limbs between them.
_POSE_NAMES = (
    "nose",
    "left_eye_inner",
    "left_eye",
    "left_eye_outer",
    "right_eye_inner",
    "right_eye",
    "right_eye_outer",
    "left_ear",
    "right_ear",
    "mouth_left",
    "mouth_right",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_pinky",
    "right_pinky",
    "left_index",
    "right_index",
    "left_thumb",
    "right_thumb",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
    "left_heel",
    "right_heel",
    "left_foot_index",
    "right_foot_index",
)
_FACE_EDGES = (
    (0, 1),
    (1, 2),
    (2, 3),
    (3, 7),
    (0, 4),
    (4, 5),
    (5, 6),
    (6, 8),
    (9, 10),
)
_TORSO_EDGES = ((11, 12), (11, 23), (12, 24), (23, 24))
_L_ARM = ((11, 13), (13, 15))
_R_ARM = ((12, 14), (14, 16))
_L_HAND = ((15, 17), (15, 19), (15, 21), (17, 19))
_R_HAND = ((16, 18), (16, 20), (16, 22), (18, 20))
_L_LEG = ((23, 25), (25, 27))
_R_LEG = ((24, 26), (26, 28))
_L_FOOT = ((27, 29), (27, 31), (29, 31))
_R_FOOT = ((28, 30), (28, 32), (30, 32))
_POSE_LIMBS = (
    _L_ARM + _R_ARM + _L_HAND + _R_HAND + _L_LEG + _R_LEG + _L_FOOT + _R_FOOT
)
_EDGES = (
    *_FACE_EDGES[:8],
    (9, 10),
    (11, 12),
    *((11, 13), (13, 15), (15, 17), (15, 19), (15, 21), (17, 19)),
    *((12, 14), (14, 16), (16, 18), (16, 20), (16, 22), (18, 20)),
    *((11, 23), (12, 24), (23, 24), (23, 25), (24, 26), (25, 27), (26, 28)),
    *((27, 29), (28, 30), (29, 31), (30, 32), (27, 31), (28, 32)),
)

# Left half and midline of an A-pose; the right half is its mirror image.
_LEFT_REST: dict[str, Vector] = {
    "nose": (0.0, 1.555, 0.125),
    "left_eye_inner": (0.016, 1.590, 0.105),
    "left_eye": (0.032, 1.592, 0.100),
    "left_eye_outer": (0.046, 1.588, 0.088),
    "left_ear": (0.075, 1.555, 0.020),
    "mouth_left": (0.026, 1.515, 0.105),
    "left_shoulder": (0.175, 1.390, 0.0),
    "left_elbow": (0.330, 1.155, -0.010),
    "left_wrist": (0.455, 0.943, 0.030),
    "left_pinky": (0.503, 0.865, 0.004),
    "left_index": (0.500, 0.862, 0.062),
    "left_thumb": (0.478, 0.893, 0.085),
    "left_hip": (0.095, 0.920, 0.0),
    "left_knee": (0.110, 0.500, 0.010),
    "left_ankle": (0.120, 0.085, -0.020),
    "left_heel": (0.120, 0.030, -0.065),
    "left_foot_index": (0.145, 0.020, 0.140),
}


def _twin(name: str) -> str:
    """The name on the other side."""
    if "left" in name:
        return name.replace("left", "right")
    return name.replace("right", "left")


def _rest_positions() -> tuple[Vector, ...]:
    """Points of the A-pose, in the order of the names."""
    # Joints of the right side are mirror images of those of the left.
    positions = []
    for name in _POSE_NAMES:
        if name in _LEFT_REST:
            positions.append(_LEFT_REST[name])
        else:
            positions.append(_mirror(_LEFT_REST[_twin(name)]))
    return tuple(positions)


def _about_x(v: Vector, cos: float, sin: float) -> Vector:
    """A vector turned about the x axis."""
    return (v[0], cos * v[1] - sin * v[2], sin * v[1] + cos * v[2])


def _rest_directions() -> dict[Edge, Vector]:
    """Direction of each bone without swing, in the frame that it is relative to.

    Upper arm and thigh point where their opposite is out of reach; elbow, knee and fingers point
    straight on (opposite: folded back onto themselves); the foot and the line across the palm have
    their neutral direction, in the frames of shin and forearm.
    """
    arm: Vector = _unit(0.6, -0.6, 0.5)
    leg: Vector = _unit(0.0, -0.8, 0.6)
    rest = dict(zip(_POSE_NAMES, _rest_positions(), strict=True))

    def neutral(a: str, b: str) -> Vector:
        offset = [y - x for x, y in zip(rest[a], rest[b], strict=True)]
        # The swing from straight down to the shin's rest direction.
        return _about_x(_unit(*offset), cos=-leg[1], sin=-leg[2])

    left: dict[Edge, Vector] = dict.fromkeys((*_L_ARM, *_L_HAND[:3]), arm)
    # The thumb's side is in front, half-way through pronation.
    left[(17, 19)] = _across((0.0, 0.0, 1.0), arm)
    left |= dict.fromkeys(_L_LEG, leg)
    left[(27, 29)] = neutral("left_ankle", "left_heel")
    left[(27, 31)] = neutral("left_ankle", "left_foot_index")
    left[(29, 31)] = neutral("left_heel", "left_foot_index")

    # Each right joint follows its left one.
    right = {(a + 1, b + 1): _mirror(v) for (a, b), v in left.items()}
    return left | right


def _mediapipe33() -> SkeletonTemplate:
    directions = _rest_directions()
    ends = [b for _, b in _POSE_LIMBS]

    def parent(limb: Edge) -> int:
        a = limb[0]
        if a in (11, 12):
            return CHEST
        if a in (23, 24):
            return PELVIS
        # Parents of fingers and of the foot's three bones are the forearm and the shin.
        base = {17: 15, 18: 16, 29: 27, 30: 28}.get(a, a)
        return N_HUBS + ends.index(base)

    # The joint on the other side; the nose is its own.
    mirror = []
    for name in _POSE_NAMES:
        twin = _twin(name)
        mirror.append(_POSE_NAMES.index(twin) if twin in _POSE_NAMES else 0)

    return SkeletonTemplate(
        names=_POSE_NAMES,
        edges=_EDGES,
        limbs=_POSE_LIMBS,
        limb_parents=tuple(parent(limb) for limb in _POSE_LIMBS),
        rest_directions=tuple(directions[limb] for limb in _POSE_LIMBS),
        rest_positions=_rest_positions(),
        stature=1.7,
        shoulders=(11, 12),
        hips=(23, 24),
        ears=(7, 8),
        eyes=(2, 5),
        nose=0,
        face=tuple(range(11)),
        mirror=tuple(mirror),
        draw_groups=(
            ("head", (*_FACE_EDGES, (7, 8))),
            ("torso", _TORSO_EDGES),
            ("left_arm", _L_ARM),
            ("right_arm", _R_ARM),
            ("left_hand", _L_HAND),
            ("right_hand", _R_HAND),
            ("left_leg", _L_LEG + _L_FOOT),
            ("right_leg", _R_LEG + _R_FOOT),
        ),
        # Without these edges, face, mouth and body are three separate components.
        gnn_edges=(*_EDGES, (0, 9), (0, 10), (0, 11), (0, 12)),
    )


MEDIAPIPE33 = _mediapipe33()
"""MediaPipe Pose: 33 joints, 35 edges, 22 limbs."""
