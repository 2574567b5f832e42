"""MediaPipe's 33 pose landmarks from the joints, and if given the vertices, of SMPL or SMPL-X.

Units are metres in any frame; landmarks that the body model lacks are NaN with confidence 0.
Confidence 1: the same point in both; 0.5: a point nearby.

Source: vertex numbers as in public loaders.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gsgan.skeleton.template import MEDIAPIPE33

# Confidences.
SAME_POINT = 1.0
NEARBY = 0.5
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LandmarkTable:
    """The source of each landmark in one kind of body; later entries override earlier ones."""

    counts: tuple[int, int]  # number of joints, number of vertices
    joints: dict[str, tuple[int, float]]  # landmark to (joint, confidence)
    vertices: dict[str, tuple[int, float]]  # landmark to (vertex, confidence)
    # landmark to (joint, vertex), about halfway between
    midpoints: dict[str, tuple[int, int]]


def _sides(
    names: dict[str, tuple[int, int]], confidence: float
) -> dict[str, tuple[int, float]]:
    """Left and right landmark from one name: ``{"hip": (1, 2)}``."""
    sided = {}
    for name, (left, right) in names.items():
        sided[f"left_{name}"] = (left, confidence)
        sided[f"right_{name}"] = (right, confidence)
    return sided


def _eyes(left: int, right: int) -> dict[str, tuple[int, float]]:
    """The eye, and its two corners as copies of it."""
    corners = {"eye_inner": (left, right), "eye_outer": (left, right)}
    return _sides({"eye": (left, right)}, SAME_POINT) | _sides(corners, NEARBY)


# SMPL's joints, left and right, which SMPL-X shares.
_ARMS = {"shoulder": (16, 17), "elbow": (18, 19), "wrist": (20, 21)}
_LEGS = {"hip": (1, 2), "knee": (4, 5), "ankle": (7, 8)}
_LIMB_JOINTS = _sides(_ARMS | _LEGS, SAME_POINT) | _sides(
    {"foot_index": (10, 11)}, NEARBY
)

TABLES = {
    # SMPL: joints of hands are near the index finger's base.
    "smpl": LandmarkTable(
        counts=(24, 6890),
        joints=_LIMB_JOINTS | _sides({"index": (22, 23)}, NEARBY),
        vertices={
            "nose": (332, SAME_POINT),
            **_eyes(2800, 6260),
            **_sides({"ear": (583, 4071), "heel": (3387, 6787)}, SAME_POINT),
            **_sides({"foot_index": (3216, 6617)}, SAME_POINT),
        },
        # MediaPipe's three points of a hand are knuckles, about half-way to the finger tips.
        midpoints={
            "left_index": (20, 2319),
            "left_pinky": (20, 2673),
            "left_thumb": (20, 2746),
            "right_index": (21, 5782),
            "right_pinky": (21, 6133),
            "right_thumb": (21, 6191),
        },
    ),
    # SMPL-X has finger joints and eyes.
    "smplx": LandmarkTable(
        counts=(55, 10475),
        joints=_LIMB_JOINTS
        | _sides(
            {"index": (25, 40), "pinky": (31, 46), "thumb": (38, 53)},
            SAME_POINT,
        )
        | {
            name: (number, NEARBY)
            for name, (number, _) in _eyes(23, 24).items()
        },
        vertices={
            "nose": (9120, SAME_POINT),
            **_eyes(9448, 9929),
            **_sides(
                {
                    "ear": (6, 616),
                    "heel": (8846, 8635),
                    "foot_index": (5770, 8463),
                },
                SAME_POINT,
            ),
        },
        midpoints={},
    ),
}


def to_mediapipe33(
    joints: ArrayLike,
    vertices: ArrayLike | None = None,
    kind: Literal["smpl", "smplx"] = "smpl",
) -> tuple[Floats, Floats]:
    """MediaPipe's 33 landmarks of posed SMPL or SMPL-X bodies.

    Args:
        joints: ``[..., 24, 3]`` (smpl) or ``[..., 55, 3]`` (smplx) metres.
        vertices: ``[..., 6890, 3]`` or ``[..., 10475, 3]``, or None, which leaves the face, the
            heels and most of SMPL's hands unknown.
        kind: "smpl" or "smplx".

    Returns:
        ``p [..., 33, 3]``, NaN where unknown (the mouth always), and ``conf [..., 33]``. A joint
        or vertex that is not finite makes its landmarks unknown too.

    Raises:
        ValueError: on a wrong shape or kind, naming the argument.
    """
    if kind not in TABLES:
        raise ValueError(
            f"to_mediapipe33: kind must be one of {list(TABLES)}, got {kind!r}"
        )

    # All landmarks are unknown at first.
    table = TABLES[kind]
    j = _points("joints", joints, table.counts[0])
    p = np.full((*j.shape[:-2], len(MEDIAPIPE33.names), 3), np.nan)
    conf = np.zeros(p.shape[:-1])

    def put(name: str, position: Floats, confidence: float) -> None:
        landmark = MEDIAPIPE33.names.index(name)
        p[..., landmark, :] = position
        conf[..., landmark] = confidence

    # Vertices are nearer to the landmarks than joints and replace them.
    for name, (joint, confidence) in table.joints.items():
        put(name, j[..., joint, :], confidence)
    if vertices is not None:
        v = _points("vertices", vertices, table.counts[1])
        for name, (vertex, confidence) in table.vertices.items():
            put(name, v[..., vertex, :], confidence)
        for name, (joint, vertex) in table.midpoints.items():
            put(name, (j[..., joint, :] + v[..., vertex, :]) / 2, NEARBY)

    # A landmark with a coordinate that is not finite is unknown.
    is_finite = np.isfinite(p).all(axis=-1)
    p[~is_finite] = np.nan
    return p, np.where(is_finite, conf, 0.0)


def _points(name: str, points: ArrayLike, count: int) -> Floats:
    array = np.asarray(points, np.float64)
    if array.ndim < 2 or array.shape[-2:] != (count, 3):
        raise ValueError(
            f"to_mediapipe33: {name} must have shape [..., {count}, 3], got {list(array.shape)}"
        )
    return array
