"""The subject's proportions, as a skeleton in a standard pose: the target of retargeting.

Convention: metres; standard axes have Z up. The standard pose is an upright T: it faces -Y, the
person's left is +X, palms down, legs straight down, the middle of the hips at the origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.skeleton import HOLISTIC, MEDIAPIPE33, bone_frames, sanitise
from gsgan.skeleton.face import FACE as FACE_LANDMARKS
from gsgan.skeleton.hands import FINGER_BONES, HAND, INDEX, PINKY, WRIST
from gsgan.skeleton.template import CHEST, HEAD, PELVIS
from gsgan.utils.errors import DataError

Float = NDArray[np.float64]

SHOULDERS, EARS, HIPS = (11, 12), (7, 8), (23, 24)
ARMS = ((11, 13), (13, 15)), ((12, 14), (14, 16))
LEGS = ((23, 25), (25, 27)), ((24, 26), (26, 28))
BONES = (*ARMS[0], *ARMS[1], *LEGS[0], *LEGS[1])  # parents first
HANDS, FEET = {15: (17, 19, 21), 16: (18, 20, 22)}, {27: (29, 31), 28: (30, 32)}
BODY = len(MEDIAPIPE33.names)
HAND_JOINTS = {15: slice(BODY, BODY + HAND), 16: slice(BODY + HAND, BODY + 2 * HAND)}  # by wrist
EXPRESSION = slice(BODY + 2 * HAND, BODY + 2 * HAND + FACE_LANDMARKS)  # lips, brows and lids
SIDES = {15: 1.0, 16: -1.0}  # of the standard pose's x
HEELS_AND_TOES = (29, 30, 31, 32)
FACE = tuple(range(11))
STANDING = 10  # percentile of a foot's heights below which it counts as standing
TO_STANDARD = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # of left, up, front


@dataclass(frozen=True)
class Figure:
    """The subject's proportions; plain values, for checkpoints.

    Args:
        joints: 33 landmarks in the standard pose, median proportions of the training frames.
        seen: per landmark, whether training frames had it (else it held a stand-in).
        ground: metres along the world's up axis, of the lowest heel or toe of a standing person.
        facing: radians about the up axis, 0 towards -Y of the standard axes: the mean heading.
        up: the world's up axis, e.g. "z" or "-y".
        hands: 42 hand landmarks in the standard pose, the left hand's first, of the training
            frames' median proportions; None where no frame has a hand.
    """

    joints: tuple[tuple[float, float, float], ...]
    seen: tuple[bool, ...]
    ground: float
    facing: float
    up: str
    hands: tuple[tuple[float, float, float], ...] | None = None

    @property
    def rest(self) -> Float:
        """``[33, 3]`` the landmarks of the standard pose."""
        return np.array(self.joints)

    @property
    def rest_with_hands(self) -> Float:
        """``[75, 3]`` with hands: the subject's, else the template's in the subject's size."""
        rest = self.rest
        if self.hands is not None:
            return np.concatenate([rest, self.hands])
        template = np.array(HOLISTIC.rest_positions)
        pinky, index, _ = HANDS[15]
        hands = {w: _hand(template[None, at], template[None, w]) for w, at in HAND_JOINTS.items()}
        sizes = [np.linalg.norm(middle(p, (pinky, index)) - p[15]) for p in (rest, template)]
        hands = {wrist: hand * sizes[0] / sizes[1] for wrist, hand in hands.items()}
        return np.concatenate([rest, _standing_hands(rest, hands)])

    @property
    def leg(self) -> float:
        """Length of thigh and shin, metres."""
        return float(sum(length(self.rest, bone) for bone in LEGS[0]))


def figure_of(p: Tensor, valid: Tensor, up: str) -> Figure:
    """The proportions of a person.

    Args:
        p: ``[F, 33, 3]`` metres, world frame; anything where not valid. Or ``[F, 75, 3]`` with the
            21 landmarks of the left hand and of the right one.
        valid: ``[F, 33]`` or ``[F, 75]``.
        up: the world's up axis.
    """
    whole, _ = sanitise(p[:, :BODY].double(), valid[:, :BODY])
    q = whole.numpy() @ upright(up).T
    hubs = bone_frames(torch.from_numpy(q)).hubs.numpy()
    rest = np.zeros((len(MEDIAPIPE33.names), 3))

    def median_length(a: Float, b: Float) -> float:
        return float(np.median(np.linalg.norm(a - b, axis=-1)))

    def local(frames: Float, points: Float) -> Float:
        """``[n, 3]`` medians of points ``[F, n, 3]`` in frames ``[F, 3, 3]``."""
        return np.asarray(np.median(points @ frames, axis=0))

    for pair, height in (
        (HIPS, 0.0),
        (SHOULDERS, median_length(middle(q, HIPS), middle(q, SHOULDERS))),
    ):
        half = median_length(q[:, pair[0]], q[:, pair[1]]) / 2
        rest[list(pair)] = [half, 0, height], [-half, 0, height]
    for limbs, ways in ((ARMS, ((1, 0, 0), (-1, 0, 0))), (LEGS, ((0, 0, -1), (0, 0, -1)))):
        for limb, way in zip(limbs, ways, strict=True):
            for a, b in limb:
                rest[b] = rest[a] + median_length(q[:, a], q[:, b]) * np.array(way)
    for wrist, ends in HANDS.items():
        held = local(hand_frame(q, wrist), q[:, ends] - q[:, wrist, None])
        rest[list(ends)] = rest[wrist] + held * (SIDES[wrist], 1.0, SIDES[wrist])
    for ankle, (heel, toe) in FEET.items():
        foot = [heel, toe]
        low = q[:, foot, 2].max(axis=1)
        stands = q[low <= np.percentile(low, STANDING)]
        ahead = (stands[:, toe] - stands[:, heel]) * (1, 1, 0)
        back = -ahead / np.maximum(np.linalg.norm(ahead, axis=-1, keepdims=True), 1e-9)
        above = np.broadcast_to([0.0, 0, 1], back.shape)
        axes = np.stack([np.cross(back, above), back, above], axis=-1)
        rest[foot] = rest[ankle] + local(axes, stands[:, foot] - stands[:, ankle, None])
    ears = middle(q, EARS)
    neck = local(hubs[:, CHEST], (ears - middle(q, SHOULDERS))[:, None]) @ TO_STANDARD.T
    pitch = float(np.median(np.arcsin(np.clip(hubs[:, HEAD, 2, 2], -1, 1))))
    level = np.array(
        [[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]]
    )  # as far as a level gaze turns the head's axes: the nose lies below the ears
    face = local(hubs[:, HEAD], q[:, FACE] - ears[:, None]) @ TO_STANDARD.T
    rest[list(FACE)] = middle(rest, SHOULDERS) + neck + face @ level
    ahead = hubs[:, PELVIS, :, 2].mean(axis=0)
    lowest = q[:, HEELS_AND_TOES, 2].min(axis=1)
    hands = _hands(p.double().numpy() @ upright(up).T, valid.numpy())
    return Figure(
        joints=_plain(rest),
        seen=tuple((valid[:, :BODY].double().mean(0) > 0.5).tolist()),
        ground=float(np.percentile(lowest, STANDING)),
        facing=float(np.arctan2(ahead[0], -ahead[1])),
        up=up,
        hands=_plain(_standing_hands(rest, hands)) if hands else None,
    )


def _plain(p: Float) -> tuple[tuple[float, float, float], ...]:
    return tuple((x, y, z) for x, y, z in p.tolist())


def _hands(p: Float, seen: NDArray[np.bool_]) -> dict[int, Float]:
    """Each hand of joints ``[F, J, 3]`` as `_hand` gives it, by its wrist; empty without any.

    A hand that is never seen whole is the other one's mirror image.
    """
    found = {}
    for wrist, hand in HAND_JOINTS.items():
        whole = seen[:, hand].all(1) & seen[:, wrist]
        if whole.any() and p.shape[1] > BODY:
            found[wrist] = _hand(p[whole, hand], p[whole, wrist])
    if len(found) == 1:
        (other,) = found.values()
        found = dict.fromkeys(HAND_JOINTS, other * (1, 1, -1)) | found
    return found


def _hand(p: Float, wrist: Float) -> Float:
    """``[21, 3]`` medians of a hand ``[F, 21, 3]`` from the pose's wrist ``[F, 3]``, in the palm's
    axes; fingers have the median lengths of their bones."""
    local = (p - wrist[:, None]) @ palm_frame(p)
    median = np.median(local, axis=0)
    held = median.copy()
    for a, b in FINGER_BONES:
        bone = median[b] - median[a]
        size = np.median(np.linalg.norm(p[:, b] - p[:, a], axis=-1))
        held[b] = held[a] + size * bone / max(float(np.linalg.norm(bone)), 1e-9)
    return held


def _standing_hands(rest: Float, hands: Mapping[int, Float]) -> Float:
    """``[42, 3]`` the hands of `_hands` at the wrists of a standard pose ``[33, 3]``."""
    return np.concatenate(
        [rest[wrist] + hand * (SIDES[wrist], 1.0, SIDES[wrist]) for wrist, hand in hands.items()]
    )


def upright(up: str) -> Float:
    """``[3, 3]`` rotation from a world whose up axis is ``up`` to standard axes, Z up.

    Raises:
        DataError: when the name is not that of an axis.
    """
    axis = "xyz".find(up[-1:])
    if axis < 0 or up[:-1] not in ("", "-"):
        raise DataError(f"up must be x, y, z, -x, -y or -z, got {up!r}")
    above = np.eye(3)[axis] * (-1 if up[:-1] else 1)
    first = np.eye(3)[(axis + 1) % 3]
    return np.stack([first, np.cross(above, first), above])


def middle(p: Float, pair: tuple[int, int]) -> Float:
    """``[..., 3]`` the middle of two joints of ``[..., J, 3]``."""
    return np.asarray(p[..., pair, :].mean(axis=-2))


def length(rest: Float, bone: tuple[int, int]) -> float:
    """Metres between two joints of ``[J, 3]``."""
    return float(np.linalg.norm(rest[bone[1]] - rest[bone[0]]))


def hand_frame(p: Float, wrist: int) -> Float:
    """``[..., 3, 3]`` a hand's axes, see `part_frame`: along it, towards the little finger."""
    pinky, index, _ = HANDS[wrist]
    return part_frame(
        middle(p, (pinky, index)) - p[..., wrist, :], p[..., pinky, :] - p[..., index, :]
    )


def palm_frame(hand: Float) -> Float:
    """``[..., 3, 3]`` axes of a palm of landmarks ``[..., 21, 3]``, as `hand_frame`'s."""
    along = middle(hand, (PINKY, INDEX)) - hand[..., WRIST, :]
    return part_frame(along, hand[..., PINKY, :] - hand[..., INDEX, :])


def part_frame(along: Float, across: Float) -> Float:
    """``[..., 3, 3]`` columns: a direction, another made orthogonal to it, their cross product."""
    a = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    b = across - (across * a).sum(-1, keepdims=True) * a
    b = b / np.maximum(np.linalg.norm(b, axis=-1, keepdims=True), 1e-9)
    return np.stack([a, b, np.cross(a, b)], axis=-1)
