"""Motions: what every reader returns, and the steps that follow for all formats.

Convention: landmarks are MediaPipe's 33, ``p [F, 33, 3]`` metres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gsgan.data.figure import BONES, HIPS, SHOULDERS, Figure, length, middle, upright
from gsgan.scene import BodyPose
from gsgan.skeleton import MEDIAPIPE33, sanitise
from gsgan.skeleton.sanitise import MIN_TRUNK_JOINTS
from gsgan.utils.errors import DataError

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

TRUNK = (*SHOULDERS, *HIPS)
FPS = 30.0  # assumed where neither the file nor the user gives it
OWN = 0.02  # largest relative difference of bone lengths at which a motion is the subject's own
SELDOM = 0.2  # a joint seen in a smaller share of the frames counts as a false detection
AXES = ("x", "y", "z", "-x", "-y", "-z")
PARENT = {b: a for a, b in MEDIAPIPE33.limbs if b not in TRUNK}


@dataclass(frozen=True)
class Motion:
    """A person in motion.

    Args:
        path: the file.
        p: ``[F, 33, 3]`` metres; NaN where a landmark is unknown.
        visibility: ``[F, 33]`` in [0, 1].
        fps: frames per second, or None if unknown.
        up: the axis that points up, or None to infer it from the skeleton.
        unit: of the file's lengths, in words.
        file_up: the file's own axis, where ``up`` is that of converted landmarks.
        body: ``[F]`` poses of the subject's body that the landmarks come from, or None.
    """

    path: Path
    p: Float
    visibility: Float
    fps: float | None
    up: str | None
    unit: str
    file_up: str | None = None
    body: BodyPose | None = None

    def __len__(self) -> int:
        return len(self.p)


def checked(motion: Motion, least_visibility: float) -> Motion:
    """The motion with unseen landmarks set to NaN.

    Shoulders and hips are kept wherever they are finite: without them there is no skeleton.

    Raises:
        DataError: when there are no frames, or fewer than three of shoulders and hips are known in
            a frame, naming the first.
    """
    if not len(motion):
        raise DataError(f"{motion.path} has no frames; expected a motion")
    known: Bool = np.isfinite(motion.p).all(-1) & (motion.visibility >= least_visibility)
    known[:, list(TRUNK)] = np.isfinite(motion.p[:, list(TRUNK)]).all(-1) & (
        motion.visibility[:, TRUNK] > 0
    )
    if len(bad := np.flatnonzero(known[:, TRUNK].sum(1) < MIN_TRUNK_JOINTS)):
        raise DataError(
            f"{motion.path}: {len(bad)} of {len(motion)} frames, the first is {bad[0]}, lack "
            "shoulders or hips (NaN, or not seen); remove these frames from the file, or "
            "fill the gaps"
        )
    p = np.where(known[..., None], motion.p, np.nan)
    return replace(motion, p=p, visibility=np.where(known, motion.visibility, 0.0))


def is_own(motion: Motion, figure: Figure) -> bool:
    """Whether the motion's bones are as long as the subject's: it needs no retargeting."""
    with np.errstate(invalid="ignore"):
        found = [np.linalg.norm(motion.p[:, b] - motion.p[:, a], axis=-1) for a, b in BONES]
    seen = [(np.median(x[np.isfinite(x)]), bone) for x, bone in zip(found, BONES, strict=True)
            if np.isfinite(x).any()]  # fmt: skip
    rest = figure.rest
    return bool(seen) and all(abs(x / length(rest, b) - 1) <= OWN for x, b in seen)


def up_axis(motion: Motion) -> str:
    """The axis nearest to the median direction from hips to shoulders, e.g. "-y"."""
    known = np.nan_to_num(motion.p)
    spine = np.median(middle(known, SHOULDERS) - middle(known, HIPS), axis=0)
    axis = int(np.abs(spine).argmax())
    return ("-" if spine[axis] < 0 else "") + AXES[axis]


def completed(motion: Motion, up: str) -> Float:
    """``[F, 33, 3]`` every landmark in standard axes, Z up.

    Gaps of a joint are interpolated linearly, relative to its parent joint. A joint that fewer than
    `SELDOM` of the frames show takes its place in the rest pose, relative to its parent.
    """
    p = motion.p @ upright(up).T
    known: Bool = np.asarray(np.isfinite(p).all(-1))
    times = np.arange(len(p))
    for joint, parent in PARENT.items():
        offset, seen = p[:, joint] - p[:, parent], known[:, joint] & known[:, parent]
        if seen.mean() < SELDOM:
            known[:, joint] = False
        elif not seen.all():
            between = np.stack([np.interp(times, times[seen], x[seen]) for x in offset.T], axis=1)
            p[:, joint] = np.where(seen[:, None], p[:, joint], p[:, parent] + between)
            known[:, joint] = known[:, parent]
    whole, _ = sanitise(torch.from_numpy(p), torch.from_numpy(known))
    return np.asarray(whole.numpy(), np.float64)


def resampled(p: Float, fps: float, wanted: float) -> Float:
    """Landmarks ``[F, 33, 3]`` at another frame rate, interpolated linearly."""
    if len(p) == 1 or fps == wanted:
        return p
    times = frame_times(len(p), fps, wanted)
    flat = p.reshape(len(p), -1)
    at = np.minimum(times.astype(int), len(p) - 2)
    share = (times - at)[:, None]
    mixed = np.where(share > 0, (1 - share) * flat[at] + share * flat[at + 1], flat[at])
    return np.asarray(mixed.reshape(len(times), *p.shape[1:]), np.float64)


def frame_times(frames: int, fps: float, wanted: float) -> Float:
    """Times of the frames at a new rate, in frames of the old rate; the last is not exceeded."""
    count = int((frames - 1) * wanted / fps + 1e-6) + 1
    return np.arange(count, dtype=np.float64) * fps / wanted
