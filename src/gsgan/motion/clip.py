"""Motions: what every reader returns, and the steps that follow for all formats.

Landmarks ``p [F, J, 3]`` in metres are MediaPipe's 33; or 75, with the 21 of the left hand and the
21 of the right one; or 105, also with the 30 of the face.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.data.skeletons import bone_lengths
from gsgan.scene import BodyPose
from gsgan.skeleton import MEDIAPIPE33, sanitise
from gsgan.skeleton.joints import BODY, FACE
from gsgan.skeleton.proportions import (
    BONES,
    HAND_JOINTS,
    HIPS,
    SHOULDERS,
    Proportions,
    axis_name,
    length,
    middle,
    upright,
)
from gsgan.skeleton.sanitise import MIN_TRUNK_JOINTS
from gsgan.utils.errors import DataError

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

TRUNK_LANDMARKS = (*SHOULDERS, *HIPS)
FPS = 30.0  # assumed if neither the file nor the user gives a rate
# Maximum relative difference of bone lengths at which a motion is the subject's own.
OWN_LENGTHS = 0.02
# A joint seen in a smaller share of the frames counts as a false detection.
MIN_BONE_SEEN = 0.2
ROUNDED = 5e-4  # relative difference of a rate from a whole number
JUST_BEYOND = 0.05  # share of a frame
MAX_GAP = 5  # frames: in a longer gap a hand or face is not seen
PARENT = {b: a for a, b in MEDIAPIPE33.limbs if b not in TRUNK_LANDMARKS}


@dataclass(frozen=True)
class Clip:
    """A person in motion."""

    path: Path  # the file
    # [F, J, 3] metres; NaN = unknown landmark. Not all formats tell where hands and face are on the
    # body
    p: Float
    visibility: Float  # [F, J] in [0, 1]
    fps: float | None  # frames per second, or None if unknown
    # the axis that points up, or None to infer it from the skeleton
    up: str | None
    unit: str  # of the file's lengths, in words
    # the up axis of the file, if up is that of converted landmarks
    file_up: str | None = None
    part: str = ""  # which part of the file it is, in words, if it has several
    # [F] poses of the subject's body that the landmarks come from, or None
    body: BodyPose | None = None
    # number of frames without shoulders and hips, see `mask_unseen`
    filled: int = 0
    # whether hands and face are not where they are on the body, so that the motion must be
    # retargeted
    detached: bool = False

    def __len__(self) -> int:
        return len(self.p)


def mask_unseen(motion: Clip, min_visibility: float) -> Clip:
    """The motion with unseen landmarks set to NaN.

    Shoulders and hips are kept wherever they are finite: without them there is no skeleton. Frames
    with fewer than three of them are interpolated between their neighbours; before the first frame
    that has them, after the last one, and where the motion has body poses, they repeat the nearest.
    Hands and face stay as they are.

    Raises:
        DataError: when there are no frames, or none in which three of shoulders and hips are known.
    """
    if not len(motion):
        raise DataError(f"{motion.path} has no frames; expected a motion")

    # Shoulders and hips count at any visibility above 0.
    trunk = list(TRUNK_LANDMARKS)
    finite: Bool = np.asarray(np.isfinite(motion.p).all(-1))
    has_place = finite & (motion.visibility >= min_visibility)
    has_place[:, trunk] = finite[:, trunk] & (motion.visibility[:, trunk] > 0)
    good = has_place[:, trunk].sum(1) >= MIN_TRUNK_JOINTS
    if not good.any():
        raise DataError(
            f"{motion.path}: none of {len(motion)} frames has shoulders and hips (NaN, or not seen)"
        )

    # Frames without a trunk are between their neighbours; body poses cannot be mixed.
    before, after, share = neighbours(good)
    nearest = np.where(share > 0.5, after, before)
    body = motion.body
    if body is not None:
        share = np.rint(share)
        body = body[torch.from_numpy(nearest)]

    # Landmarks are mixed; one that only one side has is taken from the nearer
    # frame.
    p = np.where(has_place[..., None], motion.p, np.nan)
    filled = mix(p[before], p[after], share)
    filled = np.where(np.isfinite(filled), filled, p[nearest])

    # Hands and face stay.
    visibility = np.where(has_place, motion.visibility, 0.0)
    shown = visibility[nearest]
    filled[:, BODY:] = p[:, BODY:]
    shown[:, BODY:] = visibility[:, BODY:]
    return replace(
        motion,
        p=filled,
        visibility=shown,
        body=body,
        filled=int((~good).sum()),
    )


class Neighbours(NamedTuple):
    """The nearest known frames of each of F frames."""

    before: NDArray[np.int64]  # [F]; a known frame is its own neighbour
    # [F]; the same as before if there is none on one side
    after: NDArray[np.int64]
    share: Float  # [F] of the latter, in [0, 1]


def neighbours(has_place: Bool) -> Neighbours:
    """The nearest known frames before and after each frame of ``has_place [F]``."""
    at = np.flatnonzero(has_place)
    times = np.arange(len(has_place))
    first_after = np.searchsorted(at, times)
    after = at[first_after.clip(max=len(at) - 1)]
    last_before = np.searchsorted(at, times, side="right") - 1
    before = at[last_before.clip(min=0)]
    share = (times - before) / np.maximum(after - before, 1)
    return Neighbours(before=before, after=after, share=share.clip(0, 1))


def mix(a: Float, b: Float, share: Float) -> Float:
    """Landmarks ``[F, J, 3]`` between two; if a share ``[F]`` is 0 or 1, exactly one of them."""
    share = share[:, None, None]
    between = (1 - share) * a + share * b
    between = np.where(share < 1, between, b)
    return np.where(share > 0, between, a)


def is_own(motion: Clip, subject: Proportions) -> bool:
    """Whether the motion's bones are as long as the subject's: it needs no retargeting."""
    with np.errstate(invalid="ignore"):
        lengths = bone_lengths(motion.p, BONES).T

    # The relative difference of each bone's median length.
    differences = []
    for values, bone in zip(lengths, BONES, strict=True):
        seen = values[np.isfinite(values)]
        if len(seen):
            ratio = np.median(seen) / length(subject.rest, bone)
            differences.append(abs(ratio - 1))
    return bool(differences) and bool(np.max(differences) <= OWN_LENGTHS)


def up_axis(motion: Clip) -> str:
    """The axis nearest to the median direction from hips to shoulders, e.g. "-y"."""
    places = np.nan_to_num(motion.p)
    spine = middle(places, SHOULDERS) - middle(places, HIPS)
    return axis_name(np.median(spine, axis=0))


def complete(motion: Clip, up: str) -> Float:
    """All landmarks ``[F, J, 3]`` in standard axes, Z up.

    Gaps of a joint are interpolated linearly, relative to its parent joint. A joint that fewer than
    `MIN_BONE_SEEN` of the frames show takes its place in the rest pose, relative to its parent.
    Gaps of a hand or the face of up to `MAX_GAP` frames are interpolated; in longer ones it is NaN.
    """
    # Offsets of the body's joints from their parents are interpolated.
    whole = motion.p @ upright(up).T
    p = whole[:, :BODY]
    has_place: Bool = np.asarray(np.isfinite(p).all(-1))
    times = np.arange(len(p))

    # Parents come first: a joint that is not seen follows its parent.
    for joint, parent in PARENT.items():
        offset = p[:, joint] - p[:, parent]
        seen = has_place[:, joint] & has_place[:, parent]
        if seen.mean() < MIN_BONE_SEEN:
            has_place[:, joint] = False
        elif not seen.all():
            # In between, the bone turns from where it was to where it is seen
            # again.
            gaps = ~seen
            for axis in range(3):
                filled = np.interp(times, times[seen], offset[seen, axis])
                p[gaps, joint, axis] = p[gaps, parent, axis] + filled[gaps]
            has_place[:, joint] = has_place[:, parent]

    # Joints without an offset take their places in the rest pose.
    body, _ = sanitise(torch.from_numpy(p), torch.from_numpy(has_place))

    # Hands and the face.
    parts = [body.numpy()]
    for part in (*HAND_JOINTS.values(), FACE):
        parts.append(_bridge(whole[:, part]))
    return np.concatenate(parts, axis=1)


def _bridge(part: Float) -> Float:
    """A hand or face ``[F, n, 3]``; gaps of up to `MAX_GAP` frames are interpolated."""
    is_finite: Bool = np.asarray(np.isfinite(part).all((1, 2)))
    if not is_finite.any():
        return part
    before, after, share = neighbours(is_finite)
    is_short = (after - before - 1 <= MAX_GAP) & (after > before)
    bridged = ~is_finite & is_short
    filled = mix(part[before], part[after], share)
    return np.where(bridged[:, None, None], filled, part)


def resample(p: Float, fps: float, wanted: float) -> Float:
    """Landmarks ``[F, J, 3]`` at another frame rate, interpolated linearly."""
    if len(p) == 1 or fps == wanted:
        return p
    times = frame_times(len(p), fps, wanted)
    at = np.minimum(times.astype(int), len(p) - 2)
    return mix(p[at], p[at + 1], times - at)


def frame_times(frames: int, fps: float, wanted: float) -> Float:
    """Times of the frames at a new rate, in frames of the old rate.

    The last old frame is not exceeded; a time that would be just beyond it is moved to it.
    """
    count = int((frames - 1) * wanted / fps + JUST_BEYOND) + 1
    times = np.arange(count, dtype=np.float64) * fps / wanted
    return np.minimum(times, frames - 1)


def rate_of(path: Path, value: Any) -> float:
    """A number of frames per second, as a file gives it.

    Raises:
        DataError: when it is not a number above 0.
    """
    values = np.asarray(value)
    is_number = values.dtype.kind in "iuf"
    rate = float(values.reshape(-1)[0]) if is_number else 0.0
    if not 0 < rate < 1e5:
        raise DataError(
            f"{path}: the frame rate is {value!r}; expected a number above 0"
        )
    return usual_rate(rate)


def usual_rate(rate: float) -> float:
    """The rate, or the whole number of frames per second that it is except for rounding.

    Files hold the time between frames with five to seven digits. Film's rates, such as 29.97, stay.
    """
    whole = max(1.0, round(rate))
    return whole if abs(rate / whole - 1) < ROUNDED else rate
