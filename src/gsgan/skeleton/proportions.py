"""The subject's proportions, as a skeleton in a standard pose: the target of retargeting.

Lengths are in metres; standard axes have Z up. The standard pose is an upright T: it faces -Y, the
person's left is +X, palms down, legs straight down, the middle of the hips at the origin.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsgan.skeleton import HOLISTIC, bone_frames, sanitise
from gsgan.skeleton.hands import FINGER_BONES, INDEX, PINKY, WRIST
from gsgan.skeleton.joints import BODY, LEFT, RIGHT
from gsgan.skeleton.template import CHEST, HEAD, PELVIS
from gsgan.utils.arrays import Bool, Float
from gsgan.utils.errors import DataError

# Names of the world's up axis.
UP_AXES = ("x", "y", "z", "-x", "-y", "-z")
# Numbers of MediaPipe's landmarks, the left one first.
SHOULDERS = (11, 12)
EARS = (7, 8)
HIPS = (23, 24)
SECTORS = 12  # of directions around the person
ARMS = ((11, 13), (13, 15)), ((12, 14), (14, 16))
LEGS = ((23, 25), (25, 27)), ((24, 26), (26, 28))
# All bones of the limbs, parents first.
BONES = (*ARMS[0], *ARMS[1], *LEGS[0], *LEGS[1])
# by wrist: base of the little finger, base of the index finger, thumb
HAND_LANDMARKS = {15: (17, 19, 21), 16: (18, 20, 22)}
# by ankle: heel, toes
FEET = {27: (29, 31), 28: (30, 32)}
# by wrist
HAND_JOINTS = {15: LEFT, 16: RIGHT}
# Sign of the standard pose's x, by wrist.
BODY_SIDES = {15: 1.0, 16: -1.0}
HEELS_AND_TOES = (29, 30, 31, 32)
# nose, eyes, ears, corners of the mouth
HEAD_LANDMARKS = tuple(range(11))
# percentile of a foot's heights below which it counts as standing
STANDING = 10
# rotation of the axes left, up, front
TO_STANDARD = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


@dataclass(frozen=True)
class Proportions:
    """The subject's proportions; plain values, for checkpoints.

    Args:
        joints: 33 landmarks in the standard pose, median proportions of the training frames.
        seen: per landmark, whether training frames had it (else it held a stand-in).
        ground: metres along the world's up axis, of the lowest heel or toe of a standing person.
        facing: radians about the up axis, 0 towards -Y of the standard axes: the mean heading.
        up: the world's up axis, e.g. "z" or "-y".
        hands: 42 hand landmarks in the standard pose, the left hand's first, with the median
            proportions of the training frames; None if no frame has a hand.
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

        # The template's hands, scaled by the ratio of the lengths of the palms.
        template = np.array(HOLISTIC.rest_positions)
        own_palm = _palm_length(rest)
        template_palm = _palm_length(template)

        # Each hand from its wrist, in the palm's axes.
        hands = {}
        for wrist, joints in HAND_JOINTS.items():
            hand = _hand(template[None, joints], template[None, wrist])
            hands[wrist] = hand * own_palm / template_palm
        return np.concatenate([rest, _standing_hands(rest, hands)])

    @property
    def leg(self) -> float:
        """Length of thigh and shin, metres."""
        # The left leg stands for both.
        thigh, shin = LEGS[0]
        return length(self.rest, thigh) + length(self.rest, shin)


def measure_proportions(
    p: Tensor,
    valid: Tensor,
    up: str,
) -> Proportions:
    """Measures the proportions of a person.

    Args:
        p: ``[F, 33, 3]`` metres, world frame; anything where not valid. Or ``[F, 75, 3]`` with the
            21 landmarks of the left hand and of the right one.
        valid: ``[F, 33]`` or ``[F, 75]``.
        up: the world's up axis.
    """
    # Positions in standard axes; sanitise() estimates the missing ones.
    to_standard = upright(up).T
    whole, _ = sanitise(p[:, :BODY].double(), valid[:, :BODY])
    q = whole.numpy() @ to_standard  # [F, 33, 3]
    hubs = bone_frames(torch.from_numpy(q)).hubs.numpy()  # [F, hubs, 3, 3]

    # The standard pose, part by part. Hands follow the wrists, so limbs come first.
    rest = np.zeros((BODY, 3))
    _place_limbs(rest, q)
    for wrist, (pinky, index, thumb) in HAND_LANDMARKS.items():
        ends = [pinky, index, thumb]
        frames = hand_frame(q, wrist, pinky, index)  # [F, 3, 3]
        held = _local(frames, q[:, ends] - q[:, wrist, None])  # [3, 3]
        rest[ends] = rest[wrist] + held * (
            BODY_SIDES[wrist],
            1.0,
            BODY_SIDES[wrist],
        )
    _place_feet(rest, q)
    _place_head(rest, q, hubs)
    hands = _hands(p.double().numpy() @ to_standard, valid.numpy())

    # The floor is where feet stand; the heading is that of the pelvis.
    lowest = q[:, HEELS_AND_TOES, 2].min(axis=1)  # [F]
    ahead = hubs[:, PELVIS, :, 2].mean(axis=0)
    share_seen = valid[:, :BODY].double().mean(0)
    return Proportions(
        joints=_plain(rest),
        seen=tuple((share_seen > 0.5).tolist()),
        ground=float(np.percentile(lowest, STANDING)),
        facing=float(np.arctan2(ahead[0], -ahead[1])),
        up=up,
        hands=_plain(_standing_hands(rest, hands)) if hands else None,
    )


def _place_limbs(rest: Float, q: Float) -> None:
    """Shoulders, hips, arms and legs of the standard pose, with the median lengths of ``q``."""

    def median_length(a: Float, b: Float) -> float:
        return float(np.median(np.linalg.norm(a - b, axis=-1)))

    # The trunk: hips at the origin, shoulders above them.
    trunk = median_length(middle(q, HIPS), middle(q, SHOULDERS))
    for (left, right), height in ((HIPS, 0.0), (SHOULDERS, trunk)):
        half = median_length(q[:, left], q[:, right]) / 2
        rest[left] = (half, 0, height)
        rest[right] = (-half, 0, height)

    # Arms point to the sides, legs down; each bone starts where the one before it ends.
    down = (0, 0, -1)
    ways = {
        ARMS[0]: (1, 0, 0),
        ARMS[1]: (-1, 0, 0),
        LEGS[0]: down,
        LEGS[1]: down,
    }
    for limb, way in ways.items():
        for a, b in limb:
            rest[b] = rest[a] + median_length(q[:, a], q[:, b]) * np.array(way)


def _place_feet(rest: Float, q: Float) -> None:
    """Heels and toes of the standard pose, as they stand on the floor in ``q [F, 33, 3]``."""
    for ankle, (heel, toe) in FEET.items():
        foot = [heel, toe]

        # Only the frames in which this foot stands: heel and toes are both low.
        height = q[:, foot, 2].max(axis=1)
        stands = q[height <= np.percentile(height, STANDING)]

        # Axes of the standing foot: its side, its heel's direction on the floor, up.
        ahead = (stands[:, toe] - stands[:, heel]) * (1, 1, 0)
        size = np.linalg.norm(ahead, axis=-1, keepdims=True)
        back = -ahead / np.maximum(size, 1e-9)
        above = np.broadcast_to([0.0, 0, 1], back.shape)
        # [F, 3, 3]
        axes = np.stack([np.cross(back, above), back, above], axis=-1)

        # Medians over these frames, in the foot's own axes.
        held = _local(axes, stands[:, foot] - stands[:, ankle, None])
        rest[foot] = rest[ankle] + held


def _place_head(
    rest: Float,
    q: Float,
    hubs: Float,
) -> None:
    """Face and ears of the standard pose, the gaze level, above its shoulders."""
    # From the middle of the shoulders to that of the ears, in the chest's axes.
    ears = middle(q, EARS)
    lift = (ears - middle(q, SHOULDERS))[:, None]
    neck = _local(hubs[:, CHEST], lift) @ TO_STANDARD.T

    # A level gaze turns the head's axes by this pitch: the nose lies below the ears.
    pitch = float(np.median(np.arcsin(np.clip(hubs[:, HEAD, 2, 2], -1, 1))))
    cos = np.cos(pitch)
    sin = np.sin(pitch)
    level = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])

    # The face around the middle of the ears, in the head's axes.
    features = q[:, HEAD_LANDMARKS] - ears[:, None]
    face = _local(hubs[:, HEAD], features) @ TO_STANDARD.T
    rest[list(HEAD_LANDMARKS)] = middle(rest, SHOULDERS) + neck + face @ level


def _local(frames: Float, points: Float) -> Float:
    """``[n, 3]`` medians of points ``[F, n, 3]`` in frames ``[F, 3, 3]``."""
    return np.asarray(np.median(points @ frames, axis=0))


def _plain(p: Float) -> tuple[tuple[float, float, float], ...]:
    return tuple((x, y, z) for x, y, z in p.tolist())


def _hands(p: Float, seen: Bool) -> dict[int, Float]:
    """Each hand of joints ``[F, J, 3]`` as `_hand` gives it, by its wrist; empty without any.

    A hand that is never seen whole is the other one's mirror image.
    """
    hands = {}
    for wrist, hand in HAND_JOINTS.items():
        whole = seen[:, hand].all(1) & seen[:, wrist]
        if whole.any() and p.shape[1] > BODY:
            hands[wrist] = _hand(p[whole, hand], p[whole, wrist])

    # In the palm's axes, the third coordinate alone tells left from right.
    if len(hands) == 1:
        (other,) = hands.values()
        hands = dict.fromkeys(HAND_JOINTS, other * (1, 1, -1)) | hands
    return hands


def _hand(p: Float, wrist: Float) -> Float:
    """``[21, 3]`` medians of a hand ``[F, 21, 3]`` from the pose's wrist ``[F, 3]``, in the palm's
    axes; fingers have the median lengths of their bones."""
    # [F, 21, 3]
    local = (p - wrist[:, None]) @ hand_frame(p, WRIST, PINKY, INDEX)
    median = np.median(local, axis=0)

    # Medians of positions shorten bones, so each bone gets its median length, parents first.
    held = median.copy()
    for a, b in FINGER_BONES:
        bone = median[b] - median[a]
        size = np.median(np.linalg.norm(p[:, b] - p[:, a], axis=-1))
        held[b] = held[a] + size * bone / max(float(np.linalg.norm(bone)), 1e-9)
    return held


def _standing_hands(rest: Float, hands: Mapping[int, Float]) -> Float:
    """``[42, 3]`` the hands of `_hands` at the wrists of a standard pose ``[33, 3]``."""
    # The signs turn the palm's axes into the standard axes of that side.
    placed = []
    for wrist, hand in hands.items():
        placed.append(
            rest[wrist] + hand * (BODY_SIDES[wrist], 1.0, BODY_SIDES[wrist])
        )
    return np.concatenate(placed)


def _palm_length(p: Float) -> float:
    """Metres from the left wrist of ``[J, 3]`` to the middle of the finger bases."""
    # The body's own landmarks of the hand, which every skeleton has.
    pinky, index, _ = HAND_LANDMARKS[15]
    return float(np.linalg.norm(middle(p, (pinky, index)) - p[15]))


def upright(up: str) -> Float:
    """``[3, 3]`` rotation from a world whose up axis is ``up`` to standard axes, Z up.

    Raises:
        DataError: when the name is not that of an axis.
    """
    if up not in UP_AXES:
        raise DataError(f"up must be one of {', '.join(UP_AXES)}, got {up!r}")

    # Z up is the standard; other axes are turned onto it.
    axis = "xyz".index(up[-1])
    sign = -1 if up[:-1] else 1
    above = np.eye(3)[axis] * sign
    first = np.eye(3)[(axis + 1) % 3]

    # Rows are the standard axes in the world.
    return np.stack([first, np.cross(above, first), above])


def axis_name(direction: Float) -> str:
    """The axis nearest to a direction ``[3]``: "z" or "-y"; the inverse of `upright`."""
    # The largest component decides, and its sign.
    axis = int(np.abs(direction).argmax())
    return ("-" if direction[axis] < 0 else "") + "xyz"[axis]


def middle(p: Float, pair: tuple[int, int]) -> Float:
    """``[..., 3]`` the middle of two joints of ``[..., J, 3]``."""
    return np.asarray(p[..., pair, :].mean(axis=-2))


def length(rest: Float, bone: tuple[int, int]) -> float:
    """Metres between two joints of ``[J, 3]``."""
    return float(np.linalg.norm(rest[bone[1]] - rest[bone[0]]))


def hand_frame(
    p: Float,
    wrist: int,
    pinky: int,
    index: int,
) -> Float:
    """``[..., 3, 3]`` axes of a hand, see `part_frame`: along it, towards the little finger.

    The second axis is opposite to that of `gsgan.skeleton.hands.palm_frames`.

    Args:
        p: ``[..., J, 3]`` landmarks.
        wrist, pinky, index: numbers of the wrist and of the bases of two fingers.
    """
    along = middle(p, (pinky, index)) - p[..., wrist, :]
    return part_frame(along, p[..., pinky, :] - p[..., index, :])


def part_frame(along: Float, across: Float) -> Float:
    """``[..., 3, 3]`` columns: a direction, another made orthogonal to it, their cross product."""
    # Gram-Schmidt: each direction becomes a unit vector, zero vectors stay zero.
    first = along / np.maximum(
        np.linalg.norm(along, axis=-1, keepdims=True), 1e-9
    )
    second = across - (across * first).sum(-1, keepdims=True) * first
    size = np.linalg.norm(second, axis=-1, keepdims=True)
    second = second / np.maximum(size, 1e-9)
    return np.stack([first, second, np.cross(first, second)], axis=-1)


def degrees_seen(p: Float, centres: Float) -> int:
    """Degrees around the person, of 360, from which cameras see the frames, in `SECTORS`.

    Args:
        p: ``[F, J, 3]`` metres; shoulders and hips are finite.
        centres: ``[C, 3]`` metres, the cameras' positions.
    """
    # The trunk's own axes: to the left and to the front.
    hips = middle(p, HIPS)
    left, right = (p[:, joint] for joint in SHOULDERS)
    across = left - right
    front = np.cross(across, middle(p, SHOULDERS) - hips)

    # The direction of each camera about the trunk, as a share of a turn, [C, F].
    towards = centres[:, None] - hips
    sine = (towards * front).sum(-1) * np.linalg.norm(across, axis=-1)
    cosine = (towards * across).sum(-1) * np.linalg.norm(front, axis=-1)
    turn = np.arctan2(sine, cosine) / (2 * np.pi)
    sectors = np.unique(np.floor(SECTORS * turn) % SECTORS)
    return 360 // SECTORS * len(sectors)
