"""The reader of .pose files: MediaPipe's body, hands and face, read by the package pose-format."""

from collections.abc import Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from gsgan.motion.clip import Clip, rate_of
from gsgan.motion.retarget import steady
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.face import rest_face
from gsgan.skeleton.hands import FINGERS, HAND_NAMES, WRIST
from gsgan.skeleton.joints import FACE_MESH
from gsgan.skeleton.proportions import (
    BONES,
    EARS,
    HAND_JOINTS,
    HIPS,
    SHOULDERS,
    Proportions,
    length,
)
from gsgan.utils.errors import DataError

Float = NDArray[np.float64]

GUESSED = 0.5  # visibility below which MediaPipe's hips are guesses
# Names of the parts in files of pose-format.
IMAGE_PART = "POSE_LANDMARKS"
WORLD_PART = "POSE_WORLD_LANDMARKS"
HAND_PARTS = ("LEFT_HAND_LANDMARKS", "RIGHT_HAND_LANDMARKS")
MESH_PART = "FACE_LANDMARKS"
MESH_SIZE = 478  # landmarks of MediaPipe's face mesh
# The bones of a hand without the thumb: hands differ most in where its base is.
HAND_LENGTHS: list[tuple[int, int]] = []
for _finger in FINGERS[1:]:
    HAND_LENGTHS += pairwise((WRIST, *_finger))
# The default person's face at rest, metres; NaN for landmarks that no one uses.
AVERAGE_FACE = np.full((MESH_SIZE, 3), np.nan)
AVERAGE_FACE[list(FACE_MESH.values())] = rest_face()
# Pairs of landmarks that are much further apart than an expression moves them.
FACE_LENGTHS = []
for _pair in combinations(FACE_MESH.values(), 2):
    if length(AVERAGE_FACE, _pair) > 0.05:
        FACE_LENGTHS.append(_pair)
# Rigid lengths, which show the scale of the axes.
LENGTHS = (*BONES, SHOULDERS, HIPS, EARS, (11, 23), (12, 24))


def read_pose(path: Path, subject: Proportions) -> Clip:
    """MediaPipe's landmarks in a file of the ``pose-format`` package.

    Image landmarks with MediaPipe's depth, which agree with those of the hands; without any, world
    landmarks. The package scales x and y by the image size but not z, and normalised files no
    longer hold that size: the scale of each axis is estimated from the subject's bone lengths.
    Hands and the face have scales of their own. The face is in axes fixed to the head, by all
    landmarks of the mesh that the file has.

    If the hips are hardly visible, as when people are filmed from the waist up, they are put
    upright below the shoulders.

    Raises:
        DataError: when the package is missing, the file is damaged or has no depth.
    """
    # The body in the image if the file has it, else in the world; either needs
    # a depth.
    file = _PoseFile(path)
    name = IMAGE_PART if IMAGE_PART in file.parts else WORLD_PART
    if name not in file.parts or "Z" not in file.parts[name].layout:
        raise DataError(
            f"{path} has {', '.join(file.parts)} without depth; expected MediaPipe's "
            f"{WORLD_PART} or {IMAGE_PART} in 3D"
        )

    # The body. Hips that are guesses are placed below the shoulders.
    p, visibility = file.landmarks(name, MEDIAPIPE33.names)
    person = visibility[:, SHOULDERS].all(1)

    # MediaPipe gives hips outside of the image, too.
    guessed_hips = (
        person.any() and np.median(visibility[person][:, HIPS]) < GUESSED
    )
    if guessed_hips:
        visibility[:, HIPS] = 0
    p = _to_metres(path, p, visibility, subject, pixels=name == IMAGE_PART)
    if guessed_hips:
        p[:, HIPS] = p[:, SHOULDERS] + (0, length(subject.rest, (11, 23)), 0)
        visibility[:, HIPS] = visibility[:, SHOULDERS]

    # Hands and face, if there are any.
    hands = [file.landmarks(hand, HAND_NAMES) for hand in HAND_PARTS]
    mesh_names = tuple(map(str, range(MESH_SIZE)))
    face = file.landmarks(MESH_PART, mesh_names)
    points = [p]
    confidences = [visibility]
    if any(part.confidence.any() for part in (*hands, face)):
        rest = [
            subject.rest_with_hands[joints] for joints in HAND_JOINTS.values()
        ]
        points += _parts_to_metres(hands, rest, HAND_LENGTHS)
        confidences += [hand.confidence for hand in hands]

    # The whole mesh fixes the axes of the face.
    if face.confidence.any():
        (mesh,) = _parts_to_metres([face], [AVERAGE_FACE], FACE_LENGTHS)
        chosen = list(FACE_MESH.values())
        points.append(steady(mesh)[:, chosen])
        confidences.append(face.confidence[:, chosen])

    unit = f"{name.lower().replace('_', ' ')}, scaled to the subject"
    return Clip(
        path=path,
        p=np.concatenate(points, axis=1),
        visibility=np.concatenate(confidences, axis=1),
        fps=rate_of(path, file.fps),
        up=None,
        unit=unit,
        detached=True,
    )


class _Part(NamedTuple):
    """A part of a .pose file, such as a hand."""

    columns: slice
    points: list[str]
    layout: str  # axes, such as "XYZC"


class _Landmarks(NamedTuple):
    """Points in the file's units."""

    p: Float  # [F, n, 3]; NaN = absent
    confidence: Float  # [F, n]


class _PoseFile:
    """A .pose file and its parts by name."""

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
            raise DataError(
                f"{path} has no frames with a person; expected a motion"
            )
        self.fps = pose.body.fps

        # The points of all parts are in one array, part by part.
        self.parts: dict[str, _Part] = {}
        start = 0
        for part in pose.header.components:
            stop = start + len(part.points)
            self.parts[part.name] = _Part(
                columns=slice(start, stop),
                points=part.points,
                layout=part.format,
            )
            start = stop

    def landmarks(self, name: str, points: tuple[str, ...]) -> _Landmarks:
        """The n points of a part; a part without depth counts as absent."""
        shape = (len(self.data), len(points))
        p = np.full((*shape, 3), np.nan)
        confidence = np.zeros(shape)
        part = self.parts.get(name)
        if part is None or "Z" not in part.layout:
            return _Landmarks(p, confidence)

        # The first person in each frame.
        data = self.data[:, 0, part.columns]
        own_confidence = self.confidence[:, 0, part.columns]
        for k, point in enumerate(part.points):
            point = point.lower().replace("_finger", "")
            if point in points:
                j = points.index(point)
                p[:, j] = data[:, k]
                confidence[:, j] = own_confidence[:, k]
        return _Landmarks(p, confidence)


def _to_metres(
    path: Path, p: Float, visibility: Float, subject: Proportions, pixels: bool
) -> Float:
    """Scales each of the three axes so that bones get the subject's lengths.

    The squares of the scales solve ``Σ sᵢ² dᵢ² = length²`` over all seen bones and frames, by
    non-negative least squares. For pixels, x and y take their mean scale. One unknown
    for both would leave no depth to a person with longer arms, or narrower shoulders.
    """
    # One row for each bone in each frame in which it is seen.
    rows = []
    for a, b in LENGTHS:
        ends = [a, b]
        visible = (visibility[:, ends] > 0.2).all(1)
        seen = visible & np.isfinite(p[:, ends]).all((1, 2))

        # Each bone's squared parts, over the square of its length.
        squares = (p[seen, b] - p[seen, a]) ** 2
        rows.append(squares / length(subject.rest, (a, b)) ** 2)
    table = np.concatenate(rows)
    if not len(table):
        raise DataError(
            f"{path}: no frame shows two joints of a limb; expected a person"
        )

    # Pixels are square.
    squares, _ = nnls(table, np.ones(len(table)))
    scales = np.sqrt(squares)
    if pixels:
        scales[:2] = scales[:2].mean()
    return p * scales


def _parts_to_metres(
    parts: Sequence[_Landmarks],
    rest: Sequence[Float],
    lengths: Sequence[tuple[int, int]],
) -> list[Float]:
    """Both hands, or the face, ``[F, n, 3]`` in metres.

    The scale of x and y, and that of z, solve `_to_metres`' equations for pairs of all parts that
    are as long as in ``rest [n, 3]``.
    """
    # One row for each pair in each frame: x and y together, then z.
    rows = []
    points = []
    for part, at_rest in zip(parts, rest, strict=True):
        p = np.where(part.confidence[..., None] > 0, part.p, np.nan)
        for a, b in lengths:
            squares = (p[:, b] - p[:, a]) ** 2 / length(at_rest, (a, b)) ** 2

            # x and y are pixels, z has another scale.
            x, y, z = squares.T
            rows.append(np.stack([x + y, z], axis=1))
        points.append(p)

    # Pairs that were not seen have no equation; without any, the scale is
    # unknown.
    table = np.concatenate(rows)
    table = table[np.isfinite(table).all(1)]
    if not len(table):
        return [np.full_like(p, np.nan) for p in points]

    # Squares of scales cannot be negative.
    squares, _ = nnls(table, np.ones(len(table)))
    flat, deep = np.sqrt(squares)
    return [p * (flat, flat, deep) for p in points]
