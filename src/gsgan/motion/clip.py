"""Motions: what every reader returns, and the steps that follow for all formats.

Convention: landmarks ``p [F, J, 3]`` in metres are MediaPipe's 33; or 75, with the 21 of the left
hand and of the right one; or 105, also with the 30 of the face.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.data.proportions import (
    BODY,
    BONES,
    EXPRESSION,
    HAND_JOINTS,
    HIPS,
    SHOULDERS,
    Proportions,
    axis_name,
    length,
    middle,
    upright,
)
from gsgan.data.skeletons import bone_lengths
from gsgan.scene import BodyPose
from gsgan.skeleton import MEDIAPIPE33, sanitise
from gsgan.skeleton.sanitise import MIN_TRUNK_JOINTS
from gsgan.utils.errors import DataError

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

TRUNK = (*SHOULDERS, *HIPS)
AXES = ("x", "y", "z", "-x", "-y", "-z")
FPS = 30.0  # assumed where neither the file nor the user gives it
# largest relative difference of bone lengths at which a motion is the subject's own
OWN = 0.02
# a joint seen in a smaller share of the frames counts as a false detection
SELDOM = 0.2
ROUNDED = 5e-4  # relative difference of a rate from a whole number
JUST_BEYOND = 0.05  # of a frame
GAP = 5  # frames: in a longer gap a hand or face is not seen
PARENT = {b: a for a, b in MEDIAPIPE33.limbs if b not in TRUNK}


@dataclass(frozen=True)
class Clip:
    """A person in motion.

    Args:
        path: the file.
        p: ``[F, J, 3]`` metres; NaN where a landmark is unknown. Where hands and face are on the
            body is not known in all formats.
        visibility: ``[F, J]`` in [0, 1].
        fps: frames per second, or None if unknown.
        up: the axis that points up, or None to infer it from the skeleton.
        unit: of the file's lengths, in words.
        file_up: the file's own axis, where ``up`` is that of converted landmarks.
        body: ``[F]`` poses of the subject's body that the landmarks come from, or None.
        filled: number of frames without shoulders and hips, see `checked`.
        detached: whether hands and face are not where they are on the body, so that the motion
            must be retargeted.
    """

    path: Path
    p: Float
    visibility: Float
    fps: float | None
    up: str | None
    unit: str
    file_up: str | None = None
    body: BodyPose | None = None
    filled: int = 0
    detached: bool = False

    def __len__(self) -> int:
        return len(self.p)


def checked(motion: Clip, least_visibility: float) -> Clip:
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
    known: Bool = np.isfinite(motion.p).all(-1) & (
        motion.visibility >= least_visibility
    )
    known[:, list(TRUNK)] = np.isfinite(motion.p[:, list(TRUNK)]).all(-1) & (
        motion.visibility[:, TRUNK] > 0
    )
    good: Bool = known[:, TRUNK].sum(1) >= MIN_TRUNK_JOINTS
    if not good.any():
        raise DataError(
            f"{motion.path}: none of {len(motion)} frames has shoulders and hips (NaN, or not seen)"
        )
    p = np.where(known[..., None], motion.p, np.nan)
    visibility = np.where(known, motion.visibility, 0.0)
    body = motion.body
    before, after, share = neighbours(good)
    nearest = np.where(share > 0.5, after, before)
    if body is not None:
        share = np.rint(share)
        body = body[torch.from_numpy(nearest)]
    q = mixed(p[before], p[after], share)
    shown = visibility[nearest]
    q = np.where(np.isfinite(q), q, p[nearest])
    q[:, BODY:] = p[:, BODY:]
    shown[:, BODY:] = visibility[:, BODY:]
    return replace(motion, p=q, visibility=shown, body=body, filled=int((~good).sum()))


def neighbours(known: Bool) -> tuple[NDArray[np.int64], NDArray[np.int64], Float]:
    """Per frame of ``known [F]``, the nearest known frames before and after it (itself if known;
    the same one twice where there is none on a side), and the share of the latter in [0, 1]."""
    at = np.flatnonzero(known)
    times = np.arange(len(known))
    after = at[np.searchsorted(at, times).clip(max=len(at) - 1)]
    before = at[(np.searchsorted(at, times, side="right") - 1).clip(min=0)]
    return before, after, ((times - before) / np.maximum(after - before, 1)).clip(0, 1)


def mixed(a: Float, b: Float, share: Float) -> Float:
    """Landmarks ``[F, J, 3]`` between two; where a share ``[F]`` is 0 or 1, exactly one of them."""
    s = share[:, None, None]
    return np.where(s > 0, np.where(s < 1, (1 - s) * a + s * b, b), a)


def is_own(motion: Clip, subject: Proportions) -> bool:
    """Whether the motion's bones are as long as the subject's: it needs no retargeting."""
    with np.errstate(invalid="ignore"):
        found = bone_lengths(motion.p, BONES).T
    seen = [
        (np.median(x[np.isfinite(x)]), bone)
        for x, bone in zip(found, BONES, strict=True)
        if np.isfinite(x).any()
    ]
    rest = subject.rest
    return bool(seen) and all(abs(x / length(rest, b) - 1) <= OWN for x, b in seen)


def up_axis(motion: Clip) -> str:
    """The axis nearest to the median direction from hips to shoulders, e.g. "-y"."""
    known = np.nan_to_num(motion.p)
    spine = np.median(middle(known, SHOULDERS) - middle(known, HIPS), axis=0)
    return axis_name(spine)


def completed(motion: Clip, up: str) -> Float:
    """``[F, J, 3]`` every landmark in standard axes, Z up.

    Gaps of a joint are interpolated linearly, relative to its parent joint. A joint that fewer than
    `SELDOM` of the frames show takes its place in the rest pose, relative to its parent. Gaps of a
    hand or the face of up to `GAP` frames are interpolated; in longer ones it is NaN.
    """
    both = motion.p @ upright(up).T
    p = both[:, :BODY]
    known: Bool = np.asarray(np.isfinite(p).all(-1))
    times = np.arange(len(p))
    for joint, parent in PARENT.items():
        offset = p[:, joint] - p[:, parent]
        seen = known[:, joint] & known[:, parent]
        if seen.mean() < SELDOM:
            known[:, joint] = False
        elif not seen.all():
            between = np.stack(
                [np.interp(times, times[seen], x[seen]) for x in offset.T], axis=1
            )
            p[:, joint] = np.where(seen[:, None], p[:, joint], p[:, parent] + between)
            known[:, joint] = known[:, parent]
    whole, _ = sanitise(torch.from_numpy(p), torch.from_numpy(known))
    parts = [_bridged(both[:, part]) for part in (*HAND_JOINTS.values(), EXPRESSION)]
    return np.concatenate([whole.numpy(), *parts], axis=1)


def _bridged(part: Float) -> Float:
    """``[F, n, 3]`` a hand or face, gaps of up to `GAP` frames interpolated."""
    known: Bool = np.asarray(np.isfinite(part).all((1, 2)))
    if not known.any():
        return part
    before, after, share = neighbours(known)
    short = ~known & (after - before - 1 <= GAP) & (after > before)
    return np.where(short[:, None, None], mixed(part[before], part[after], share), part)


def resampled(p: Float, fps: float, wanted: float) -> Float:
    """Landmarks ``[F, J, 3]`` at another frame rate, interpolated linearly."""
    if len(p) == 1 or fps == wanted:
        return p
    times = frame_times(len(p), fps, wanted)
    at = np.minimum(times.astype(int), len(p) - 2)
    return mixed(p[at], p[at + 1], times - at)


def frame_times(frames: int, fps: float, wanted: float) -> Float:
    """Times of the frames at a new rate, in frames of the old rate; the last is not exceeded, and
    one that would be just beyond it is the last."""
    count = int((frames - 1) * wanted / fps + JUST_BEYOND) + 1
    times = np.arange(count, dtype=np.float64) * fps / wanted
    return np.minimum(times, frames - 1)


def rate_of(path: Path, value: Any) -> float:
    """A number of frames per second, as a file gives it.

    Raises:
        DataError: when it is not a number above 0.
    """
    rate = (
        float(np.asarray(value).reshape(-1)[0])
        if np.asarray(value).dtype.kind in "iuf"
        else 0
    )
    if not 0 < rate < 1e5:
        raise DataError(
            f"{path}: the frame rate is {value!r}; expected a number above 0"
        )
    return usual_rate(rate)


def usual_rate(rate: float) -> float:
    """A whole number of frames per second where a rate is one but for rounding: files hold the time
    between frames with five to seven digits. Film's rates, such as 29.97, stay."""
    whole = max(1.0, round(rate))
    return whole if abs(rate / whole - 1) < ROUNDED else rate
