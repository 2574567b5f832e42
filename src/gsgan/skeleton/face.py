"""Landmarks of a face: lips, brows and lids, and their offsets from the face at rest.

They represent what a face adds to a sign: the mouth's shape, brows, gaze and blinks. The oval is
left out, because the pose's own ears, eyes and nose determine the head's position and rotation.
Units and axes are as in `gsgan.skeleton.template`.
"""

from itertools import pairwise

from torch import Tensor

from gsgan.skeleton.template import MEDIAPIPE33, Edge, SkeletonTemplate, Vector
from gsgan.skeleton.tensors import constants

# round the outer edge: 0 left corner, 3 top, 6 right corner, 9 bottom
LIP_POINTS = 12
BROW_POINTS = 5  # from the nose outwards
LID_POINTS = ("inner", "upper", "outer", "lower")
SIDES = ("left", "right")
LIPS = tuple(f"mouth_outer_{k}" for k in range(LIP_POINTS))


def _brow(side: str) -> tuple[str, ...]:
    return tuple(f"{side}_brow_{k}" for k in range(BROW_POINTS))


def _lid(side: str) -> tuple[str, ...]:
    return tuple(f"{side}_lid_{name}" for name in LID_POINTS)


# Left and right.
BROWS = (_brow("left"), _brow("right"))
LIDS = (_lid("left"), _lid("right"))
FACE_NAMES = (*LIPS, *BROWS[0], *BROWS[1], *LIDS[0], *LIDS[1])
"""In the order of face3d.npz."""
FACE = len(FACE_NAMES)

CODE_UNIT = 0.005
"""Metres per unit of `face_code`: in speech and signs these landmarks move by 2 to 10 mm, in body
heights a hundredth of what joints move by."""

# Left half and midline: the default person's, as deep as the pose's own eyes and mouth.
_LEFT_FACE: dict[str, Vector] = {
    "mouth_outer_0": (0.026, 1.515, 0.105),
    "mouth_outer_1": (0.022, 1.520, 0.110),
    "mouth_outer_2": (0.012, 1.526, 0.118),
    "mouth_outer_3": (0.0, 1.527, 0.120),
    "mouth_outer_9": (0.0, 1.509, 0.120),
    "mouth_outer_10": (0.013, 1.511, 0.117),
    "mouth_outer_11": (0.022, 1.512, 0.109),
    "left_brow_0": (0.015, 1.601, 0.110),
    "left_brow_1": (0.025, 1.603, 0.109),
    "left_brow_2": (0.038, 1.605, 0.105),
    "left_brow_3": (0.050, 1.604, 0.095),
    "left_brow_4": (0.062, 1.598, 0.075),
    "left_lid_inner": (0.016, 1.590, 0.105),
    "left_lid_upper": (0.033, 1.596, 0.103),
    "left_lid_outer": (0.046, 1.588, 0.088),
    "left_lid_lower": (0.033, 1.584, 0.102),
}


def _twin(name: str) -> str:
    """The landmark on the other side."""
    if name in LIPS:  # counted round the mouth, whose middle is at the top
        return LIPS[(LIP_POINTS // 2 - LIPS.index(name)) % LIP_POINTS]
    if "left" in name:
        return name.replace("left", "right")
    return name.replace("right", "left")


def rest_face() -> tuple[Vector, ...]:
    """Positions of the landmarks in the rest pose of the skeleton templates, metres."""

    def place(name: str) -> Vector:
        if name in _LEFT_FACE:
            return _LEFT_FACE[name]
        x, y, z = _LEFT_FACE[_twin(name)]
        return -x, y, z

    return tuple(place(name) for name in FACE_NAMES)


def face_mirror(start: int) -> tuple[int, ...]:
    """Per landmark its counterpart's number, if the first one has the number ``start``."""
    return tuple(start + FACE_NAMES.index(_twin(name)) for name in FACE_NAMES)


def face_groups(start: int) -> tuple[tuple[str, tuple[Edge, ...]], ...]:
    """Connections, by the names of the drawn channels: lips and lids are rings, brows chains."""

    def join_chains(*chains: tuple[str, ...]) -> tuple[Edge, ...]:
        numbers = (
            [start + FACE_NAMES.index(name) for name in chain]
            for chain in chains
        )
        return tuple(pair for chain in numbers for pair in pairwise(chain))

    # A ring returns to its first landmark.
    rings = [(*ring, ring[0]) for ring in (LIPS, *LIDS)]
    return (
        ("brows", join_chains(*BROWS)),
        ("eyes", join_chains(*rings[1:])),
        ("lips", join_chains(rings[0])),
    )


def face_links(start: int) -> tuple[Edge, ...]:
    """Edges to the pose's mouth and eyes, which connect lips, brows and lids to the graph."""
    # The corners of the mouth, the middles of the brows and the corners of the lids.
    ends = {"mouth_left": LIPS[0], "mouth_right": LIPS[LIP_POINTS // 2]}
    for side, brow, lid in zip(SIDES, BROWS, LIDS, strict=True):
        ends[f"{side}_eye"] = brow[BROW_POINTS // 2]
        ends[f"{side}_eye_inner"] = lid[0]
        ends[f"{side}_eye_outer"] = lid[2]
    names = MEDIAPIPE33.names
    return tuple(
        (names.index(a), start + FACE_NAMES.index(b)) for a, b in ends.items()
    )


def in_head(
    points: Tensor, p: Tensor, head: Tensor, template: SkeletonTemplate
) -> Tensor:
    """``[B, N, 3]`` metres: points in the head's axes, from the middle of ears, eyes and nose.

    Args:
        points: ``[B, N, 3]`` metres, world frame.
        p: ``[B, J, 3]`` finite joints, of which only those of the head are used.
        head: ``[B, 3, 3]`` the head's frame, see `gsgan.skeleton.bone_frames`.
        template: of the joints.
    """
    c = constants(template, p.device, p.dtype)
    middle = p.index_select(1, c.head_points).mean(1, keepdim=True)
    return (points - middle) @ head


def face_code(
    p: Tensor, head: Tensor, template: SkeletonTemplate
) -> Tensor | None:
    """``[B, E, 3]`` offsets of the face's landmarks from the face at rest, in units of `CODE_UNIT`.

    Offsets are in the head's axes; they are zero for a face at rest, however the head turns, and so
    for one that `sanitise` placed. Differentiable in p. None for a skeleton without a face.

    Args:
        p: ``[B, J, 3]`` finite joints, metres, world frame.
        head: ``[B, 3, 3]`` the head's frame, see `gsgan.skeleton.bone_frames`.
        template: of the joints.
    """
    if not template.expression:
        return None
    c = constants(template, p.device, p.dtype)
    offsets = in_head(p.index_select(1, c.expression), p, head, template)
    return (offsets - c.face_rest) / CODE_UNIT
