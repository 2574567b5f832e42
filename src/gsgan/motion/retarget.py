"""Retargeting: a motion's directions with the subject's own bone lengths, hands, feet and face.

Convention: standard axes (`gsgan.data.proportions`), Z up, metres.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from torch import Tensor

from gsgan.data.proportions import (
    BODY,
    BONES,
    EARS,
    EXPRESSION,
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
from gsgan.motion.rotations import axis_angle, between, rotation, unit
from gsgan.motion.standard import StandardMotion, drift, floor_under
from gsgan.skeleton import MEDIAPIPE33, bone_frames, in_head
from gsgan.skeleton.hands import FINGER_BONES, INDEX, PINKY, WRIST
from gsgan.skeleton.template import CHEST, HEAD, PELVIS

Float = NDArray[np.float64]

PALM = (WRIST, PINKY, INDEX)  # landmarks of a hand that give its axes
STILL = 0.001  # metres: landmarks of a face that move less count fully in its alignment
ROUNDS = 10  # of the alignment
# radians, the largest bend of the neck: detectors place faces too far forward
NECK = 0.45


def retargeted(p: Float, subject: Proportions, scale: float | None = None) -> Float:
    """``[F, J, 3]`` the subject in the poses of another person's landmarks ``[F, J, 3]``, finite.

    Trunk and limbs keep their directions and get the subject's lengths; face, hands and feet are
    the subject's own, rotated as the source's. The path is scaled by the ratio of leg lengths.

    With hand landmarks, J = 75, palms are rotated as these show and fingers keep their directions;
    where in the world they are does not matter. A hand with NaN stays NaN.

    A face, J = 105, is given as `expressed` returns it, and put on the head. NaN stays NaN.

    Args:
        p: of the other person.
        subject: the subject's proportions.
        scale: of the path, in place of that ratio.
    """
    whole, given, p = np.full_like(p, np.nan), p, p[:, :BODY]
    rest = subject.rest
    q = whole[:, :BODY]
    if scale is None:
        legs = [
            np.linalg.norm(p[:, b] - p[:, a], axis=-1) for limb in LEGS for a, b in limb
        ]
        scale = 2 * subject.leg / float(np.median(legs, axis=1).sum())
    hips = middle(p, HIPS) * scale
    chest = hips + unit(middle(p, SHOULDERS) - middle(p, HIPS)) * rest[SHOULDERS[0], 2]
    for pair, centre in ((HIPS, hips), (SHOULDERS, chest)):
        half = unit(p[:, pair[0]] - p[:, pair[1]]) * length(rest, pair) / 2
        q[:, pair[0]] = centre + half
        q[:, pair[1]] = centre - half
    for a, b in BONES:
        q[:, b] = q[:, a] + unit(p[:, b] - p[:, a]) * length(rest, (a, b))
    for wrist, ends in HAND_LANDMARKS.items():
        turn = hand_frame(p, wrist, *ends[:2]) @ hand_frame(rest, wrist, *ends[:2]).T
        if given.shape[1] > BODY:
            at, palm = _posed_hand(given[:, HAND_JOINTS[wrist]], subject, wrist)
            whole[:, HAND_JOINTS[wrist]] = q[:, wrist, None] + at
            turn = np.where(np.isfinite(palm), palm, turn)
        q[:, ends] = q[:, wrist, None] + (rest[list(ends)] - rest[wrist]) @ turn.mT
    for ankle, feet in FEET.items():
        turn = _foot_frame(p, ankle) @ _foot_frame(rest, ankle).T
        q[:, feet] = q[:, ankle, None] + (rest[list(feet)] - rest[ankle]) @ turn.mT
    neck = middle(rest, EARS) - middle(rest, SHOULDERS)
    level = bone_frames(torch.from_numpy(p)).hubs[:, CHEST].numpy() @ (
        TO_STANDARD.T @ neck
    )
    bend = axis_angle(between(level, middle(p, EARS) - middle(p, SHOULDERS)))
    most = NECK / np.maximum(np.linalg.norm(bend, axis=-1, keepdims=True), NECK)
    ears = chest + (rotation(bend * most) @ level[..., None])[..., 0]
    turn = _head_frame(p) @ _head_frame(rest[None]).mT
    q[:, HEAD_LANDMARKS] = (
        ears[:, None] + (rest[list(HEAD_LANDMARKS)] - middle(rest, EARS)) @ turn.mT
    )
    centre = q[:, MEDIAPIPE33.head].mean(1, keepdims=True)
    whole[:, EXPRESSION] = centre + given[:, EXPRESSION] @ _head_frame(q).mT
    return whole


def expressed(p: Float, rest: Float) -> Float:
    """``[F, 30, 3]`` the subject's face with another person's expressions, in the head's axes.

    One similarity aligns all frames with the subject's face. Offsets from the median over the
    frames, the other person's face at rest, are added to the subject's face at rest.

    Args:
        p: the other person's landmarks ``[F, 30, 3]`` in axes fixed to the head, of any place, turn
            and unit; NaN where not seen.
        rest: ``[30, 3]`` metres, the subject's, see `gsgan.skeleton.in_head`.

    Returns:
        Metres; NaN where not seen.
    """
    given = torch.from_numpy(p)
    own = torch.from_numpy(rest)
    seen = given.isfinite().all(-1).double().reshape(1, -1, 1)
    found = _aligned(given.reshape(1, -1, 3), own.repeat(len(given), 1), seen).reshape(
        p.shape
    )
    return (own + found - found.nanmedian(0).values).numpy()


def steadied(p: Float) -> Float:
    """Landmarks of a face ``[F, n, 3]``, metres, NaN where not seen, in axes fixed to the head.

    Frames are aligned with their median. Landmarks that move much count little in the frame's
    alignment: a jaw that drops does not nod the head.
    """
    found = torch.from_numpy(p)
    seen = found.isfinite().all(-1, keepdim=True).double()
    usual = found[seen.sum((1, 2)).argmax()]
    weight = seen * usual.isfinite()[:, :1]
    for _ in range(ROUNDS):
        found = _aligned(found, usual.nan_to_num(), weight)
        usual = found.nanmedian(0).values
        moved = (found - usual).square().sum(-1, keepdim=True) / STILL**2
        weight = (1 / (1 + moved)).nan_to_num()  # Cauchy's
    return found.numpy()


def _aligned(p: Tensor, onto: Tensor, weight: Tensor) -> Tensor:
    """Points ``[F, n, 3]`` moved by the similarity of each frame that brings them nearest to
    ``onto [n, 3]``, by weights ``[F, n, 1]``, 0 for NaN (Umeyama 1991)."""
    weight = weight / weight.sum(1, keepdim=True).clamp_min(1e-9)
    centre = (weight * p.nan_to_num()).sum(1, keepdim=True)
    a = p - centre
    to = (weight * onto).sum(1, keepdim=True)
    flat = weight * a.nan_to_num()
    U, S, Vh = torch.linalg.svd(flat.mT @ (onto - to))
    S[:, 2] *= torch.linalg.det(U @ Vh)
    U[..., 2] *= torch.linalg.det(U @ Vh)[:, None]
    size = S.sum(-1) / (flat * a.nan_to_num()).sum((1, 2))
    return to + size[:, None, None] * a @ U @ Vh


def _posed_hand(p: Float, subject: Proportions, wrist: int) -> tuple[Float, Float]:
    """The subject's hand as landmarks ``[F, 21, 3]`` show it: ``[F, 21, 3]`` from the pose's wrist,
    and the palm's rotation since the standard pose ``[F, 3, 3]``; NaN where the palm is unknown."""
    rest = subject.rest_with_hands[HAND_JOINTS[wrist]]
    palm = hand_frame(p, *PALM) @ hand_frame(rest, *PALM).T
    q = (rest - subject.rest[wrist]) @ palm.mT
    for a, b in FINGER_BONES:
        q[:, b] = q[:, a] + unit(p[:, b] - p[:, a]) * length(rest, (a, b))
    return q, palm


def _foot_frame(p: Float, ankle: int) -> Float:
    heel, toe = FEET[ankle]
    return part_frame(
        p[..., toe, :] - p[..., heel, :], p[..., ankle, :] - p[..., heel, :]
    )


def _head_frame(p: Float) -> Float:
    return bone_frames(torch.from_numpy(p)).hubs[:, HEAD].numpy()


def rig_landmarks(standard: StandardMotion, subject: Proportions) -> Float:
    """``[F, 33, 3]`` landmarks of a rig, in standard axes and the subject's size.

    Shoulders, elbows, wrists, hips, knees and ankles are the rig's joints. Rigs have no landmarks
    of hands, feet and face: the subject's own are rotated as the rig's hands, feet and head.
    """
    rest = subject.rest
    scale = subject.leg / standard.leg
    p = np.full((len(standard.joints["Hips"]), *rest.shape), np.nan)
    for i, side in enumerate(("Left", "Right")):
        names = ("Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot")
        for bone, landmark in zip(names, (11, 13, 15, 23, 25, 27), strict=True):
            p[:, landmark + i] = standard.joints[side + bone] * scale
        for bone, start, ends in (("Hand", 15, HAND_LANDMARKS), ("Foot", 27, FEET)):
            points = rest[list(ends[start + i])]
            turn = standard.turns[side + bone]
            p[:, ends[start + i]] = (
                p[:, start + i, None] + (points - rest[start + i]) @ turn.mT
            )
    if "Head" in standard.turns:
        neck = middle(rest, EARS) - middle(rest, SHOULDERS)
        ears = middle(p, SHOULDERS) + (standard.turns["Neck"] @ neck)
        face = rest[list(HEAD_LANDMARKS)] - middle(rest, EARS)
        p[:, HEAD_LANDMARKS] = ears[:, None] + face @ standard.turns["Head"].mT
    return p


def joined(clips: Sequence[Float], subject: Proportions, n: int) -> Float:
    """Clips ``[F, J, 3]`` of the subject, one after the other, with transitions of n frames.

    A transition is a cubic that continues the joints' speeds at both ends, on the subject's bones;
    without a hand or face that either end lacks (NaN).
    """
    parts = [clips[0]]
    for (a, b), after in zip(
        pairwise(map(face_in_head, clips)), clips[1:], strict=True
    ):
        speeds = [x[-1] - x[-2] if len(x) > 1 else 0 * x[0] for x in (a, b[1::-1])]
        ends = np.stack([a[-1], b[0]])
        speed = np.stack([speeds[0], -speeds[1]])
        path = CubicHermiteSpline(
            [0, n + 1], *(np.nan_to_num(x) for x in (ends, speed))
        )
        known = np.isfinite(ends).all((0, 2))[:, None]
        between = np.where(known, path(np.arange(1, n + 1)), np.nan)
        parts += [retargeted(between, subject, scale=1.0), after]
    return np.concatenate(parts)


def face_in_head(p: Float) -> Float:
    """Landmarks ``[F, J, 3]`` with those of the face as `retargeted` takes them."""
    body = torch.from_numpy(p[:, :BODY])
    face = torch.from_numpy(p[:, EXPRESSION])
    local = in_head(face, body, bone_frames(body).hubs[:, HEAD], MEDIAPIPE33)
    return np.concatenate([p[:, : EXPRESSION.start], local.numpy()], axis=1)


def heading(p: Float) -> float:
    """The direction that the hips of ``[J, 3]`` face: radians about the up axis, 0 towards -Y."""
    front = bone_frames(torch.from_numpy(p[None, :BODY])).hubs[0, PELVIS, :, 2]
    return float(torch.atan2(front[0], -front[1]))


def placed(
    p: Float,
    subject: Proportions,
    centre: Float,
    fps: float,
    *,
    ground: bool,
    stay: bool,
) -> Float:
    """Landmarks ``[F, J, 3]`` moved to where the subject was captured.

    Convention: the motion starts at the centre, with the subject's mean heading.

    Args:
        p: standard axes.
        subject: the subject's proportions.
        centre: ``[3]`` metres, standard axes: of the training frames; its height is not used.
        fps: of the frames.
        ground: keep a foot on the ground except in jumps; otherwise only the lowest foot of the
            whole motion touches it.
        stay: subtract the path of a person who walks away, as on a treadmill.
    """
    q = p @ rotation(np.array([0, 0, subject.facing - heading(p[0])])).T
    path = middle(q, HIPS)[:, :2]
    lowest = q[:, HEELS_AND_TOES, 2].min(axis=1)
    floor = (
        floor_under(lowest, subject.leg, 1 / fps)
        if ground
        else np.full(len(q), lowest.min())
    )
    gone = drift(path, 1 / fps) if stay else path[:1]
    q[..., :2] += centre[:2] - np.broadcast_to(gone, path.shape)[:, None]
    q[..., 2] += (subject.ground - floor)[:, None]
    return q
