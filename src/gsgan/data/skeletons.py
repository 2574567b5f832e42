"""Skeletons and body poses by frame number, with estimates for missing joints."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsgan.skeleton import (
    HOLISTIC,
    MEDIAPIPE33,
    SkeletonTemplate,
    bone_frames,
    in_head,
    limb_length_sum,
    sanitise,
)
from gsgan.skeleton.face import FACE
from gsgan.skeleton.hands import HAND
from gsgan.skeleton.template import HEAD, Vector
from gsgan.skeleton.tensors import constants
from gsgan.utils.arrays import Bool, Float, nanmedian
from gsgan.utils.errors import DataError
from gsgan.utils.frame_files import LARGEST_FRAME

SKELETONS = {"mediapipe33": 33}
# shoulders and hips: the bone frames of the whole body depend on them
HUBS = (11, 12, 23, 24)


@dataclass(frozen=True)
class Landmarks:
    """Skeletons by frame: ``p [J, 3]`` metres, finite, and ``visibility [J]`` in [0, 1].

    A joint of visibility 0 is an estimate. ``source`` names the file or folder of the landmarks,
    for messages.
    """

    p: Mapping[int, Float]
    visibility: Mapping[int, Float]
    source: str = "landmarks3d.npz"

    def visible_joints(self, frame: int) -> Float:
        """``[N, 3]`` the visible joints of a frame."""
        return self.p[frame][self.visibility[frame] > 0]

    def joints(self, frames: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Joints ``[F, J, 3]`` in metres, and ``[F, J]`` whether each of them is visible."""
        # Visibility 0 marks an estimate.
        p = np.stack([self.p[frame] for frame in frames])
        visibility = np.stack([self.visibility[frame] for frame in frames])
        return torch.from_numpy(p), torch.from_numpy(visibility) > 0

    def with_hands(self, hands: Landmarks) -> Landmarks:
        """Skeletons of 75 joints; hands of frames that have none are not seen."""
        return self._beside(hands, 2 * HAND)

    def with_face(self, face: Landmarks) -> Landmarks:
        """Skeletons with 30 more joints; faces of frames that have none are not seen."""
        return self._beside(face, FACE)

    def _beside(self, part: Landmarks, joints: int) -> Landmarks:
        """Skeletons with the ``joints`` joints of a part appended."""
        # A part that a frame lacks has visibility 0.
        nothing = np.zeros((joints, 3))
        unseen = np.zeros(joints)
        p = {}
        visibility = {}
        for frame, joint_places in self.p.items():
            added = part.p.get(frame, nothing)
            p[frame] = np.concatenate([joint_places, added])
            seen = part.visibility.get(frame, unseen)
            visibility[frame] = np.concatenate([self.visibility[frame], seen])
        return Landmarks(p, visibility, self.source)


@dataclass(frozen=True)
class Poses:
    """Body poses by frame: ``theta [bones, 3]`` axis-angle, ``transl [3]`` metres.

    ``fitted`` says that `gsgan.fit` made them: in the frames ``registered`` from the masks of the
    cameras ``fitted_to``, in all others from the skeleton alone. ``with_hands`` are the poses that
    follow hand landmarks too, or None.
    """

    theta: Mapping[int, Float]
    transl: Mapping[int, Float]
    source: str = "body_pose.npz"
    fitted: bool = False
    registered: frozenset[int] = frozenset()
    fitted_to: tuple[str, ...] = ()
    with_hands: Poses | None = None

    def digest(self, frames: Iterable[int]) -> str:
        """A hash of the poses of those frames."""
        # The bytes of all rotations and translations, frame by frame.
        digest = hashlib.sha256()
        for frame in frames:
            digest.update(self.theta[frame].tobytes())
            digest.update(self.transl[frame].tobytes())
        return digest.hexdigest()


def make_landmarks(
    ids: NDArray[np.int64],
    p: Float,
    conf: Float,
    max_reach: float,
    notes: list[str],
    source: str = "landmarks3d.npz",
) -> Landmarks:
    """Skeletons of all frames, missing joints filled with estimates of visibility 0.

    A joint is missing if it is not finite, its confidence is not above 0, or it lies further than
    ``max_reach`` from the rest of the body. It takes its position in the nearest frame that has it,
    or the mean of the frame's joints; hips are placed as in `hips_below`.

    Args:
        ids: ``[F]`` frame numbers in any order, each once.
        p: ``[F, J, 3]`` metres.
        conf: ``[F, J]``.
        max_reach: metres from the median joint.
        notes: gains a sentence when joints are too far.
        source: file or folder, for messages.

    Raises:
        DataError: when most joints are too far.
    """
    # Missing joints have visibility 0.
    finite = np.isfinite(p).all(-1)
    visibility = np.where(finite, np.nan_to_num(conf), 0.0).clip(0, 1)  # [F, J]
    valid = visibility > 0

    # So do joints too far from the median of their frame's joints.
    centre = np.nan_to_num(nanmedian(np.where(valid[..., None], p, np.nan), 1))
    with np.errstate(over="ignore"):  # an infinite distance is too far as well
        offset = np.nan_to_num(p, posinf=0, neginf=0) - centre[:, None]
        distance = np.linalg.norm(offset, axis=-1)
    far = valid & (distance > max_reach)
    if 2 * far.sum() > valid.sum():
        raise DataError(
            f"{source}: joints are {np.median(distance[valid]):.3g} m from the middle of the body "
            "in the median, which no person is; are its lengths in another unit?"
        )
    if far.any():
        visibility[far] = 0
        notes.append(
            f"{int(far.sum())} joints further than {max_reach:g} m from the body are taken "
            "as missing"
        )

    # Frames in rising order, holes filled from the nearest ones.
    order = np.argsort(ids)
    ids = ids[order]
    visibility = visibility[order]
    valid = visibility > 0
    p = fill_missing(p[order], valid, ids)

    # Hands and faces have no hips.
    if p.shape[1] == len(MEDIAPIPE33.names):
        p = hips_below(p, valid)
    frames = ids.tolist()
    return Landmarks(
        p=dict(zip(frames, p, strict=True)),
        visibility=dict(zip(frames, visibility, strict=True)),
        source=source,
    )


def usual_step(frames: NDArray[np.int64]) -> float:
    """The usual difference between frame numbers ``[F]`` that rise: 2 if every other was kept."""
    return float(np.median(np.diff(frames))) if len(frames) > 1 else 1.0


def whole_frame_ids(raw: NDArray[Any], where: str) -> NDArray[np.int64]:
    """Frame numbers, checked to be whole and unique.

    Raises:
        DataError: if they are not.
    """
    # NaN and infinity are found below, without a warning here.
    with np.errstate(invalid="ignore"):
        ids = np.asarray(raw, np.int64)

    # The conversion cuts off fractions, and makes other numbers of NaN.
    if not np.array_equal(ids, raw):
        raise DataError(f"{where}: 'frame_id' must hold whole numbers")
    if len(ids) and ids.max() > LARGEST_FRAME:
        raise DataError(
            f"{where}: frame_id {ids.max()} is a time stamp, not a frame number up to "
            f"{LARGEST_FRAME}; number the frames 0, 1, 2 … alike in images and landmarks"
        )

    # Each frame once.
    values, counts = np.unique(ids, return_counts=True)
    repeated = values[counts > 1]
    if len(repeated):
        raise DataError(
            f"{where}: frame_id {repeated[0]} appears more than once"
        )
    return ids


def fill_missing(
    p: Float,
    valid: Bool,
    ids: NDArray[np.int64],
) -> Float:
    """Finite estimates of missing joints.

    Args:
        p: ``[F, J, 3]``, anything where not valid.
        valid: ``[F, J]``.
        ids: ``[F]`` rising frame numbers, which define the nearest frame.

    Returns:
        ``[F, J, 3]``: the joint of the nearest frame that has it (the earlier of two), else the
        mean of the frame's valid joints, else 0.
    """
    filled = np.where(valid[..., None], p, 0.0)

    # The means of the frames' valid joints, 0 without any.
    count = valid.sum(1, keepdims=True).clip(1)
    means = filled.sum(1) / count  # [F, 3]
    for joint in range(p.shape[1]):
        # Rows of the frames that have this joint, and of those that lack it.
        present = np.flatnonzero(valid[:, joint])
        holes = np.flatnonzero(~valid[:, joint])
        if len(present) == 0:
            filled[:, joint] = means
            continue

        # The known frames before and after each hole, in rows.
        place = np.searchsorted(present, holes)
        after = present[place.clip(0, len(present) - 1)]
        before = present[(place - 1).clip(0)]

        # The nearer of the two, in frame numbers.
        back = np.abs(ids[holes] - ids[before])
        ahead = np.abs(ids[after] - ids[holes])
        nearest = np.where(back <= ahead, before, after)
        filled[holes, joint] = p[nearest, joint]
    return filled


def hips_below(p: Float, valid: Bool) -> Float:
    """Joints ``p [F, 33, 3]`` with hips placed below the shoulders in frames that show none.

    Only frames that show (``valid [F, 33]``) both shoulders and no hip change. The hips follow the
    shoulders at the same distance and direction in the world, so that the trunk does not nod with
    the head: the median of the frames that show the whole trunk; without any, along the median
    direction from ears to shoulders, as far as in the template. Metres.
    """
    shoulders = list(HUBS[:2])
    hips = list(HUBS[2:])
    ears = list(MEDIAPIPE33.ears)

    # Frames to repair, and frames to learn the trunk's direction from.
    hung = valid[:, shoulders].all(1) & ~valid[:, hips].any(1)
    whole = valid[:, HUBS].all(1)
    headed = valid[:, shoulders + ears].all(1)
    if not (hung.any() and (whole | headed).any()):
        return p

    # From the middle of the shoulders to that of the hips.
    top = p[:, shoulders].mean(1)  # [F, 3]
    if whole.any():
        trunks = p[:, hips].mean(1) - top  # [F, 3]
        down = np.median(trunks[whole], axis=0)
    else:
        necks = top - p[:, ears].mean(1)
        down = np.median(necks[headed], axis=0)
        size = median_limb_length_sum(
            torch.from_numpy(p), torch.from_numpy(valid)
        )
        reach = MEDIAPIPE33.rest_torso[1] * size / MEDIAPIPE33.limb_length_sum
        down *= reach / np.linalg.norm(down)

    # The hips are parallel to the shoulders seen along the trunk, as narrow as in the template.
    axis = down / np.linalg.norm(down)
    line = p[:, shoulders[0]] - p[:, shoulders[1]]
    line -= (line @ axis)[:, None] * axis
    rest = np.array(MEDIAPIPE33.rest_positions)
    wide = np.linalg.norm(rest[shoulders[0]] - rest[shoulders[1]])
    narrow = np.linalg.norm(rest[hips[0]] - rest[hips[1]])
    half = line * (narrow / wide / 2)

    # Half of the hips' width to each side.
    result = p.copy()
    result[hung, hips[0]] = (top + down + half)[hung]
    result[hung, hips[1]] = (top + down - half)[hung]
    return result


def bone_lengths(p: Float, bones: Sequence[tuple[int, int]]) -> Float:
    """``[..., B]`` lengths of bones of ``p [..., J, 3]``; NaN if an end is NaN."""
    # The joints at the two ends of every bone.
    starts, ends = np.array(bones).T
    return np.asarray(
        np.linalg.norm(p[..., ends, :] - p[..., starts, :], axis=-1)
    )


def median_limb_length_sum(p: Tensor, valid: Tensor) -> float:
    """Metres: the summed limb lengths, median over frames, see `limb_length_sum`."""
    return float(limb_length_sum(p, valid).nanmedian())


def face_at_rest(
    landmarks: Landmarks,
    face: Landmarks,
    trained: Sequence[int],
) -> tuple[Vector, ...]:
    """Metres: a person's face without expression, see `gsgan.skeleton.in_head`.

    The positions are medians over the training frames; a landmark that none has takes the
    template's.

    Args:
        landmarks: of the capture.
        face: its faces.
        trained: training frames.
    """
    # The face comes after the body's joints.
    p, seen = landmarks.with_face(face).joints(trained)
    first = len(MEDIAPIPE33.names)

    # Face landmarks in the head's axes.
    body, valid = sanitise(p[:, :first], seen[:, :first])
    head = bone_frames(body, valid).hubs[:, HEAD]
    local = in_head(p[:, first:], body, head, MEDIAPIPE33)  # [F, 30, 3]

    # Medians over the frames that show them.
    unseen = ~seen[:, first:, None]
    mean = local.masked_fill(unseen, torch.nan).nanmedian(0).values
    usual = constants(HOLISTIC, mean.device, mean.dtype).face_rest
    rest = torch.where(mean.isnan(), usual, mean)
    return tuple((x, y, z) for x, y, z in rest.tolist())


def complete_skeletons(
    landmarks: Landmarks,
    frames: Sequence[int],
    trained: Sequence[int],
    template: SkeletonTemplate = MEDIAPIPE33,
    hands: Landmarks | None = None,
    face: Landmarks | None = None,
) -> Landmarks:
    """Every frame's joints, with estimates of those that were not seen.

    Done once per capture, so that no frame is repaired while it is rendered: some of a template's
    joints are in no body model (the mouth), so with SMPL every frame would be.

    Args:
        landmarks: of the capture.
        frames: to complete.
        trained: frames that set the sum of limb lengths, which gives the length of missing bones.
        template: of the skeletons.
        hands, face: of the capture, if the template has them.
    """
    limbs = median_limb_length_sum(*landmarks.joints(trained))

    # The landmarks that the template asks for, in its order.
    whole = landmarks
    if template.palms and hands is not None:
        whole = whole.with_hands(hands)
    if template.expression and face is not None:
        whole = whole.with_face(face)

    # Joints that are seen stay as they are.
    p, visible = whole.joints(frames)
    completed, _ = sanitise(p, visible, template, limbs)
    return replace(whole, p=dict(zip(frames, completed.numpy(), strict=True)))
