"""The reader of .pose files: MediaPipe's body, hands and face, read by the package pose-format."""

from collections.abc import Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gsgan.data.joints import FACE_MESH
from gsgan.data.proportions import (
    BONES,
    EARS,
    HAND_JOINTS,
    HIPS,
    SHOULDERS,
    Proportions,
    length,
)
from gsgan.motion.clip import Clip, rate_of
from gsgan.motion.retarget import steadied
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.face import rest_face
from gsgan.skeleton.hands import FINGERS, HAND_NAMES, WRIST
from gsgan.utils.errors import DataError

Float = NDArray[np.float64]

GUESSED = 0.5  # visibility below which MediaPipe's hips are guesses
# in files of pose-format
IMAGE = "POSE_LANDMARKS"
WORLD = "POSE_WORLD_LANDMARKS"
HAND_PARTS = ("LEFT_HAND_LANDMARKS", "RIGHT_HAND_LANDMARKS")
MESH = "FACE_LANDMARKS"
MESH_SIZE = 478
# Without the thumb: hands differ most in where its base is.
HAND_LENGTHS = tuple(bone for f in FINGERS[1:] for bone in pairwise((WRIST, *f)))
AVERAGE_FACE = np.full((MESH_SIZE, 3), np.nan)
AVERAGE_FACE[list(FACE_MESH.values())] = rest_face()
# Pairs of landmarks that are further apart than an expression moves them, by far.
FACE_LENGTHS = tuple(
    pair
    for pair in combinations(FACE_MESH.values(), 2)
    if length(AVERAGE_FACE, pair) > 0.05
)
# rigid, for the scale of axes
LENGTHS = (*BONES, SHOULDERS, HIPS, EARS, (11, 23), (12, 24))


def read_pose(path: Path, subject: Proportions) -> Clip:
    """MediaPipe's landmarks in a file of the ``pose-format`` package.

    Image landmarks with MediaPipe's depth, which agree with those of the hands; without any, world
    landmarks. The package scales x and y by the image size but not z, and normalised files no
    longer hold that size: the scale of each axis is estimated from the subject's bone lengths.
    Hands and the face have scales of their own. The face is in axes fixed to the head, by all
    landmarks of the mesh that the file has.

    Hips that are hardly seen, as of people filmed from the waist up, are put upright below the
    shoulders.

    Raises:
        DataError: when the package is missing, the file is damaged or has no depth.
    """
    file = _PoseFile(path)
    name = next((n for n in (IMAGE, WORLD) if n in file.parts), None)
    if name is None or "Z" not in file.parts[name][2]:
        raise DataError(
            f"{path} has {', '.join(file.parts)} without depth; expected MediaPipe's "
            f"{WORLD} or {IMAGE} in 3D"
        )
    p, visibility = file.landmarks(name, MEDIAPIPE33.names)
    person = visibility[:, SHOULDERS].all(1)
    if hidden := person.any() and np.median(visibility[person][:, HIPS]) < GUESSED:
        visibility[:, HIPS] = 0
    p = _to_metres(path, p, visibility, subject, pixels=name == IMAGE)
    if hidden:
        p[:, HIPS] = p[:, SHOULDERS] + (0, length(subject.rest, (11, 23)), 0)
        visibility[:, HIPS] = visibility[:, SHOULDERS]
    hands = [file.landmarks(hand, HAND_NAMES) for hand in HAND_PARTS]
    face = file.landmarks(MESH, tuple(str(number) for number in range(MESH_SIZE)))
    if any(seen.any() for _, seen in (*hands, face)):
        whole = subject.rest_with_hands
        rest = [whole[at] for at in HAND_JOINTS.values()]
        p = np.concatenate([p, *_parts_to_metres(hands, rest, HAND_LENGTHS)], axis=1)
        visibility = np.concatenate([visibility, *(seen for _, seen in hands)], axis=1)
    if face[1].any():
        (mesh,) = _parts_to_metres([face], [AVERAGE_FACE], FACE_LENGTHS)
        ours = list(FACE_MESH.values())
        p = np.concatenate([p, steadied(mesh)[:, ours]], axis=1)
        visibility = np.concatenate([visibility, face[1][:, ours]], axis=1)
    unit = f"{name.lower().replace('_', ' ')}, scaled to the subject"
    return Clip(path, p, visibility, rate_of(path, file.fps), None, unit, detached=True)


class _PoseFile:
    """A .pose file: ``parts`` has the columns, points and layout of each part by name."""

    def __init__(self, path: Path) -> None:
        try:
            from pose_format import Pose
        except ImportError:
            raise DataError(
                f"{path} needs the package pose-format: pip install 'gsgan[render]'"
            ) from None
        try:
            pose = Pose.read(path.read_bytes())
            self.data = np.ma.getdata(pose.body.data).astype(np.float64)
            self.confidence = np.asarray(pose.body.confidence, np.float64)
        except Exception as error:  # its parser raises many kinds
            raise DataError(
                f"{path} is not a valid .pose file ({type(error).__name__})"
            ) from error
        if self.data.ndim != 4 or 0 in self.data.shape[:2]:
            raise DataError(f"{path} has no frames with a person; expected a motion")
        self.fps = pose.body.fps
        self.parts = dict[str, Any]()
        start = 0
        for part in pose.header.components:
            columns = slice(start, start := start + len(part.points))
            self.parts[part.name] = columns, part.points, part.format

    def landmarks(self, part: str, names: tuple[str, ...]) -> tuple[Float, Float]:
        """``[F, n, 3]`` the points of a part by name, NaN where absent; confidence ``[F, n]``."""
        shape = len(self.data), len(names)
        p = np.full((*shape, 3), np.nan)
        seen = np.zeros(shape)
        columns, points, layout = self.parts.get(part, (slice(0), [], ""))
        for k, point in enumerate(points if "Z" in layout else ()):
            if (known := point.lower().replace("_finger", "")) in names:
                j = names.index(known)
                p[:, j] = self.data[:, 0, columns][:, k]
                seen[:, j] = self.confidence[:, 0, columns][:, k]
        return p, seen


def _to_metres(
    path: Path, p: Float, visibility: Float, subject: Proportions, pixels: bool
) -> Float:
    """Scales each of the three axes so that bones get the subject's lengths.

    The squares of the scales solve ``Σ sᵢ² dᵢ² = length²`` over all seen bones and frames, by
    non-negative least squares. Pixels are square: x and y then take the mean of theirs. One unknown
    for both would leave no depth to a person with longer arms, or narrower shoulders.
    """
    rows = []
    for a, b in LENGTHS:
        seen = (visibility[:, (a, b)] > 0.2).all(1) & np.isfinite(p[:, (a, b)]).all(
            (1, 2)
        )
        rows.append((p[seen, b] - p[seen, a]) ** 2 / length(subject.rest, (a, b)) ** 2)
    table = np.concatenate(rows)
    if not len(table):
        raise DataError(
            f"{path}: no frame shows two joints of a limb; expected a person"
        )
    scales = np.sqrt(nnls(table, np.ones(len(table)))[0])
    if pixels:
        scales[:2] = scales[:2].mean()
    return np.asarray(p * scales)


def _parts_to_metres(
    parts: Sequence[tuple[Float, Float]],
    rest: Sequence[Float],
    lengths: Sequence[tuple[int, int]],
) -> list[Float]:
    """Both hands, or the face, ``[F, n, 3]``, of points and confidences.

    The scale of x and y, and that of z, solve `_to_metres`' equations for pairs of all parts that
    are as long as in ``rest [n, 3]``.
    """
    rows = []
    found = []
    for (p, seen), at_rest in zip(parts, rest, strict=True):
        p = np.where(seen[..., None] > 0, p, np.nan)
        for a, b in lengths:
            bone = (p[:, b] - p[:, a]) ** 2 / length(at_rest, (a, b)) ** 2
            rows.append(np.stack([bone[:, 0] + bone[:, 1], bone[:, 2]], axis=1))
        found.append(p)
    table = np.concatenate(rows)
    table = table[np.isfinite(table).all(1)]
    if not len(table):
        return [np.full_like(p, np.nan) for p in found]
    flat, deep = np.sqrt(nnls(table, np.ones(len(table)))[0])
    return [p * (flat, flat, deep) for p in found]
