"""Retargeting: a motion's directions with the subject's own bone lengths, hands, feet and face.

Axes are the standard ones (`gsgan.skeleton.proportions`), Z up; units are metres.
"""

from collections.abc import Iterable, Sequence
from itertools import chain, pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from torch import Tensor

from gsgan.motion.rotations import axis_angle, between, matvec, rotation, unit
from gsgan.motion.standard import StandardMotion, drift, floor_under
from gsgan.skeleton import MEDIAPIPE33, bone_frames, in_head
from gsgan.skeleton.hands import FINGER_BONES, INDEX, PINKY, WRIST
from gsgan.skeleton.joints import BODY, FACE
from gsgan.skeleton.proportions import (
    BONES,
    EARS,
    FEET,
    HAND_JOINTS,
    HAND_LANDMARKS,
    HEAD_LANDMARKS,
    HEELS_AND_TOES,
    HIPS,
    LEGS,
    SHOULDERS,
    TO_STANDARD,
    Proportions,
    hand_frame,
    length,
    middle,
    part_frame,
)
from gsgan.skeleton.template import CHEST, HEAD, PELVIS
from gsgan.utils.tensors import squared_norm

Float = NDArray[np.float64]

PALM_LANDMARKS = (WRIST, PINKY, INDEX)  # landmarks of a hand that give its axes
# Metres: landmarks that move less count fully in the face's alignment.
FACE_STILL = 0.001
ALIGN_ROUNDS = 10  # iterations of the alignment
# Radians: detectors place faces too far forward.
MAX_NECK_BEND = 0.45
RIG_JOINTS = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
# Landmarks of these joints on the left; those on the right are one more.
LEFT_LANDMARKS = (11, 13, 15, 23, 25, 27)


def retarget(
    p: Float, subject: Proportions, scale: float | None = None
) -> Float:
    """The subject's landmarks ``[F, J, 3]`` in the poses of another person.

    Trunk and limbs keep their directions and get the subject's lengths; face, hands and feet are
    the subject's own, rotated as the source's. The path is scaled by the ratio of leg lengths.

    With hand landmarks, J = 75, palms are rotated as these show and fingers keep their directions;
    their place in the world does not matter. A hand with NaN stays NaN.

    A face, J = 105, is given as `transfer_face` returns it, and put on the head. NaN stays NaN.

    Args:
        p: ``[F, J, 3]`` landmarks of the other person; those of the body are finite.
        subject: the subject's proportions.
        scale: of the path, in place of that ratio.
    """
    given = p
    p = given[:, :BODY]
    rest = subject.rest
    result = np.full_like(given, np.nan)
    q = result[:, :BODY]

    # The path, scaled by the median lengths of the legs.
    if scale is None:
        legs = []
        for a, b in chain.from_iterable(LEGS):
            legs.append(np.linalg.norm(p[:, b] - p[:, a], axis=-1))
        scale = 2 * subject.leg / float(np.median(legs, axis=1).sum())
    hips = middle(p, HIPS) * scale

    # Hips and shoulders, each pair about its middle.
    upward = unit(middle(p, SHOULDERS) - middle(p, HIPS))
    chest = hips + upward * rest[SHOULDERS[0], 2]
    for pair, centre in ((HIPS, hips), (SHOULDERS, chest)):
        left, right = pair
        half = unit(p[:, left] - p[:, right]) * length(rest, pair) / 2
        q[:, left] = centre + half
        q[:, right] = centre - half

    # Arms and legs, from the trunk outwards.
    _extend(q, p, rest, BONES)

    # Hands: turned as the palm's three landmarks of the pose, or better as the hand's own.
    for wrist, ends in HAND_LANDMARKS.items():
        # The hand turns with the line of the knuckles, or with its own
        # landmarks.
        first, second = ends[:2]
        axes = hand_frame(p, wrist, first, second)
        turn = axes @ hand_frame(rest, wrist, first, second).T
        if given.shape[1] > BODY:
            hand = HAND_JOINTS[wrist]
            from_wrist, palm = _pose_hand(given[:, hand], subject, wrist)
            result[:, hand] = q[:, wrist, None] + from_wrist
            turn = np.where(np.isfinite(palm), palm, turn)
        offsets = rest[list(ends)] - rest[wrist]
        q[:, ends] = q[:, wrist, None] + offsets @ turn.mT

    # Feet: turned as heel, toe and ankle.
    for ankle, feet in FEET.items():
        turn = _foot_frame(p, ankle) @ _foot_frame(rest, ankle).T
        offsets = rest[list(feet)] - rest[ankle]
        q[:, feet] = q[:, ankle, None] + offsets @ turn.mT

    # The neck, bent from the chest's axes by at most `MAX_NECK_BEND`
    neck = middle(rest, EARS) - middle(rest, SHOULDERS)
    chest_axes = bone_frames(torch.from_numpy(p)).hubs[:, CHEST].numpy()
    straight = chest_axes @ (TO_STANDARD.T @ neck)
    shown = middle(p, EARS) - middle(p, SHOULDERS)
    bend = axis_angle(between(straight, shown))
    angle = np.linalg.norm(bend, axis=-1, keepdims=True)
    bend = bend * (MAX_NECK_BEND / np.maximum(angle, MAX_NECK_BEND))
    ears = chest + matvec(rotation(bend), straight)

    # The head, and the face on it.
    turn = _head_frame(p) @ _head_frame(rest[None]).mT
    from_ears = rest[list(HEAD_LANDMARKS)] - middle(rest, EARS)
    q[:, HEAD_LANDMARKS] = ears[:, None] + from_ears @ turn.mT
    centre = q[:, MEDIAPIPE33.head].mean(1, keepdims=True)
    result[:, FACE] = centre + given[:, FACE] @ _head_frame(q).mT
    return result


def transfer_face(p: Float, rest: Float) -> Float:
    """The subject's face ``[F, 30, 3]`` with another person's expressions, in the head's axes.

    One similarity aligns all frames with the subject's face. Offsets from the median over the
    frames, the other person's face at rest, are added to the subject's face at rest.

    Args:
        p: the other person's landmarks ``[F, 30, 3]`` in axes fixed to the head, with any origin,
            rotation and unit; NaN where not seen.
        rest: ``[30, 3]`` metres, the subject's, see `gsgan.skeleton.in_head`.

    Returns:
        Metres; NaN where not seen.
    """
    # All frames as one, whose points are aligned with as many copies of the subject's face.
    given = torch.from_numpy(p)
    rest_places = torch.from_numpy(rest)
    seen = given.isfinite().all(-1).double().reshape(1, -1, 1)
    onto = rest_places.repeat(len(given), 1)
    face = _align(given.reshape(1, -1, 3), onto, seen).reshape(p.shape)

    # Expressions are offsets from the other person's face at rest.
    at_rest, _ = face.nanmedian(0)
    return (rest_places + face - at_rest).numpy()


def steady(p: Float) -> Float:
    """Landmarks of a face ``[F, n, 3]``, metres, NaN where not seen, in axes fixed to the head.

    Frames are aligned with their median. Landmarks that move much count little in the frame's
    alignment: a jaw that drops does not nod the head.
    """
    # At first, the frame with most landmarks stands for the median.
    aligned = torch.from_numpy(p)
    seen = aligned.isfinite().all(-1, keepdim=True).double()
    usual = aligned[seen.sum((1, 2)).argmax()]
    weight = seen * usual.isfinite()[:, :1]
    for _ in range(ALIGN_ROUNDS):
        aligned = _align(aligned, usual.nan_to_num(), weight)
        usual, _ = aligned.nanmedian(0)

        # Cauchy's weights.
        moved = squared_norm(aligned - usual) / FACE_STILL**2
        weight = (1 / (1 + moved)).nan_to_num()
    return aligned.numpy()


def _align(p: Tensor, onto: Tensor, weight: Tensor) -> Tensor:
    """Points moved by the similarity of each frame that brings them nearest to others.

    With centred points a and b and weights w, the rotation is ``U diag(1, 1, det) Vᵀ`` of the
    singular value decomposition ``U S Vᵀ = Σ w a bᵀ`` (Umeyama 1991).

    Args:
        p: ``[F, n, 3]``.
        onto: ``[n, 3]``.
        weight: ``[F, n, 1]``, 0 for NaN.
    """
    # Both sets of points about their centres.
    weight = weight / weight.sum(1, keepdim=True).clamp_min(1e-9)
    a = p - (weight * p.nan_to_num()).sum(1, keepdim=True)
    centre = (weight * onto).sum(1, keepdim=True)
    b = onto - centre
    weighted = weight * a.nan_to_num()
    U, S, Vh = torch.linalg.svd(weighted.mT @ b)

    # A reflection becomes a rotation by the sign of the smallest singular value.
    det = torch.linalg.det(U @ Vh)
    S[:, 2] *= det
    U[..., 2] *= det[:, None]
    spread = (weighted * a.nan_to_num()).sum((1, 2))
    scale = S.sum(-1) / spread
    return centre + scale[:, None, None] * a @ U @ Vh


def _pose_hand(
    p: Float, subject: Proportions, wrist: int
) -> tuple[Float, Float]:
    """The subject's hand in the pose of landmarks ``[F, 21, 3]``.

    Returns:
        Landmarks ``[F, 21, 3]`` from the pose's wrist, and the palm's rotation ``[F, 3, 3]`` since
        the standard pose; NaN if the palm is unknown.
    """
    rest = subject.rest_with_hands[HAND_JOINTS[wrist]]
    # The palm turns as a whole.
    axes = hand_frame(p, *PALM_LANDMARKS)
    palm = axes @ hand_frame(rest, *PALM_LANDMARKS).T
    q = (rest - subject.rest[wrist]) @ palm.mT

    # Fingers keep their own directions.
    _extend(q, p, rest, FINGER_BONES)
    return q, palm


def _extend(
    q: Float, p: Float, rest: Float, bones: Iterable[tuple[int, int]]
) -> None:
    """Places the ends of bones of ``q`` in the directions of ``p``, at the lengths of ``rest``."""
    for a, b in bones:
        way = unit(p[:, b] - p[:, a])
        q[:, b] = q[:, a] + way * length(rest, (a, b))


def _foot_frame(p: Float, ankle: int) -> Float:
    """Axes ``[..., 3, 3]`` of a foot, along the sole and up to the ankle."""
    heel, toe = FEET[ankle]
    origin = p[..., heel, :]
    return part_frame(p[..., toe, :] - origin, p[..., ankle, :] - origin)


def _head_frame(p: Float) -> Float:
    """Axes ``[F, 3, 3]`` of the head."""
    return bone_frames(torch.from_numpy(p)).hubs[:, HEAD].numpy()


def rig_landmarks(standard: StandardMotion, subject: Proportions) -> Float:
    """Landmarks ``[F, 33, 3]`` of a rig, in standard axes and the subject's size.

    Shoulders, elbows, wrists, hips, knees and ankles are the rig's joints. Rigs have no landmarks
    of hands, feet and face: the subject's own are rotated as the rig's hands, feet and head.
    """
    # The joints, and the subject's landmarks of hands and feet.
    rest = subject.rest
    scale = subject.leg / standard.leg
    p = np.full((len(standard.joints["Hips"]), *rest.shape), np.nan)
    for i, side in enumerate(("Left", "Right")):
        for bone, landmark in zip(RIG_JOINTS, LEFT_LANDMARKS, strict=True):
            p[:, landmark + i] = standard.joints[side + bone] * scale
        for bone, start, landmarks in (
            ("Hand", 15, HAND_LANDMARKS),
            ("Foot", 27, FEET),
        ):
            joint = start + i
            ends = landmarks[joint]
            offsets = rest[list(ends)] - rest[joint]
            turned = offsets @ standard.turns[side + bone].mT
            p[:, ends] = p[:, joint, None] + turned

    # The head, at the end of the neck.
    if "Head" in standard.turns:
        neck = middle(rest, EARS) - middle(rest, SHOULDERS)
        ears = middle(p, SHOULDERS) + (standard.turns["Neck"] @ neck)
        face = rest[list(HEAD_LANDMARKS)] - middle(rest, EARS)
        p[:, HEAD_LANDMARKS] = ears[:, None] + face @ standard.turns["Head"].mT
    return p


def join(clips: Sequence[Float], subject: Proportions, n: int) -> Float:
    """Clips ``[F, J, 3]`` of the subject, one after the other, with transitions of n frames.

    A transition is a cubic that continues the joints' speeds at both ends, on the subject's bones;
    hands and faces that either end lacks (NaN) are missing in it.

    Raises:
        ValueError: if a clip has no frame.
    """
    for i, clip in enumerate(clips):
        if not len(clip):
            raise ValueError(f"joined: clip {i} has no frame")
    parts = [clips[0]]
    for before, after in pairwise(clips):
        a = face_in_head(before)
        b = face_in_head(after)

        # Positions and speeds at both ends.
        ends = np.stack([a[-1], b[0]])
        speeds = np.zeros_like(ends)
        if len(a) > 1:
            speeds[0] = a[-1] - a[-2]
        if len(b) > 1:
            speeds[1] = b[1] - b[0]

        # Speeds are per frame, and so are the spline's positions.
        path = CubicHermiteSpline(
            x=[0, n + 1],
            y=np.nan_to_num(ends),
            dydx=np.nan_to_num(speeds),
        )

        # Landmarks that an end lacks are missing in between.
        has_path = np.isfinite(ends).all((0, 2))[:, None]
        transition = np.where(has_path, path(np.arange(1, n + 1)), np.nan)
        parts.append(retarget(transition, subject, scale=1.0))
        parts.append(after)
    return np.concatenate(parts)


def face_in_head(p: Float) -> Float:
    """Landmarks ``[F, J, 3]`` with the face in the head's axes, as `retarget` takes it."""
    body = torch.from_numpy(p[:, :BODY])
    face = torch.from_numpy(p[:, FACE])
    local = in_head(face, body, bone_frames(body).hubs[:, HEAD], MEDIAPIPE33)
    return np.concatenate([p[:, : FACE.start], local.numpy()], axis=1)


def heading(p: Float) -> float:
    """The direction that the hips of ``[J, 3]`` face: radians about the up axis, 0 towards -Y."""
    # The pelvis' third axis points to the front.
    front = bone_frames(torch.from_numpy(p[None, :BODY])).hubs[0, PELVIS, :, 2]
    return float(torch.atan2(front[0], -front[1]))


def place(
    p: Float,
    subject: Proportions,
    centre: Float,
    fps: float,
    *,
    ground: bool,
    stay: bool,
) -> Float:
    """Landmarks ``[F, J, 3]`` moved to where the subject was captured.

    The motion starts at the centre, with the subject's mean heading.

    Args:
        p: standard axes.
        subject: the subject's proportions.
        centre: ``[3]`` of the training frames: metres, standard axes; its height is not used.
        fps: of the frames.
        ground: keep a foot on the ground except in jumps; otherwise only the lowest foot of the
            whole motion touches it.
        stay: subtract the path of a person who walks away, as on a treadmill.
    """
    # The subject's heading.
    turn = rotation(np.array([0, 0, subject.facing - heading(p[0])]))
    q = p @ turn.T

    # The ground below the feet.
    lowest = q[:, HEELS_AND_TOES, 2].min(axis=1)
    floor = np.full(len(q), lowest.min())
    if ground:
        floor = floor_under(lowest, subject.leg, 1 / fps)

    # The start of the path, or all of it that leads away.
    path = middle(q, HIPS)[:, :2]
    gone = drift(path, 1 / fps) if stay else path[:1]
    q[..., :2] += centre[:2] - np.broadcast_to(gone, path.shape)[:, None]
    q[..., 2] += (subject.ground - floor)[:, None]
    return q
