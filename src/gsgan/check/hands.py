"""Doubtful hands: on the wrong arm, exchanged in one camera, with bones that change, jittering.

Convention: as in `gsgan.check.frames`; hands are ``[F, 2, 21, ...]``, the left one first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsgan.check.frames import shortened
from gsgan.check.report import Finding
from gsgan.check.settings import Limits
from gsgan.check.views import Subject, nanmedian
from gsgan.data.crop import project
from gsgan.data.files import read_arrays
from gsgan.data.formats.consistency import Bool, Float
from gsgan.data.joints import PALM, WRISTS
from gsgan.data.skeletons import whole_frame_ids
from gsgan.skeleton.hands import FINGER_BONES, HAND
from gsgan.utils.arrays import expect_array

SIDES = ("left", "right")
BONES = np.array([*((0, j) for j in PALM), *FINGER_BONES])
RATIO = 2.0  # a hand is exchanged where it lies this many times nearer to the other one's place
METRES = 0.06  # and this much nearer: hands touch
JITTER = 0.15  # change of a bone's length from frame to frame, median: triangulated hands have 0.05


@dataclass(frozen=True)
class Hands:
    """The hands of all frames.

    Args:
        p, visible: ``[F, 2, 21, 3]`` metres, ``[F, 2, 21]``.
        wrists, known: of the pose: ``[F, 2, 3]`` metres, ``[F, 2]``.
    """

    p: Float
    visible: Bool
    wrists: Float
    known: Bool


def hands_of(subject: Subject) -> Hands | None:
    """The hands of a dataset, or None where it has none."""
    held = subject.layout.hands
    if held is None:
        return None
    both = subject.layout.landmarks.with_hands(held)
    frames = [int(f) for f in subject.frames]
    p = np.stack([both.p[f][-2 * HAND :] for f in frames]).reshape(-1, 2, HAND, 3)
    visible = np.stack([both.visibility[f][-2 * HAND :] > 0 for f in frames])
    return Hands(p, visible.reshape(-1, 2, HAND), subject.p[:, WRISTS], subject.visible[:, WRISTS])


def hand_findings(subject: Subject, limits: Limits) -> list[Finding]:
    """What is wrong with the hands, a sentence each."""
    hands = hands_of(subject)
    if hands is None:
        return []
    texts = []

    def where(flags: Bool) -> str:
        frames = [int(f) for f in subject.frames[flags]]
        return f"{len(frames)} of {len(flags)} frames: {shortened(frames)}"

    for side, swapped in enumerate(exchanged(hands).T):
        if swapped.any():
            here, there = SIDES[side], SIDES[1 - side]
            texts.append(f"the {here} hand lies at the {there} wrist in {where(swapped)}")
    lengths = bone_lengths(hands)
    change = np.abs(lengths / nanmedian(lengths) - 1)
    for side, name in enumerate(SIDES):
        steps = np.abs(np.diff(lengths[:, side], axis=0)) / nanmedian(lengths[:, side])
        jitter = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 0.0
        odd = (change[:, side] > limits.limb_share).sum(1) > len(BONES) / 4
        if jitter > JITTER:
            text = f"the {name} hand jitters: its bones change by {jitter:.0%} from frame to frame"
            texts.append(text)
        elif odd.any():
            texts.append(f"bones of the {name} hand are off in {where(odd)}")
    for camera in subject.cameras:
        seen = detections(subject, camera)
        if seen is None:
            continue
        swapped = exchanged_in(subject, camera, hands, seen)
        if swapped.any():
            texts.append(
                f"camera {camera}: left and right hand are exchanged in its detections in "
                f"{where(swapped)}"
            )
    return [Finding("warning", "hands", text) for text in texts]


def exchanged(hands: Hands) -> Bool:
    """``[F, 2]`` hands whose wrist lies at the other arm's."""
    root = hands.p[:, :, 0]
    own, other = (
        np.linalg.norm(root - wrists, axis=-1) for wrists in (hands.wrists, hands.wrists[:, ::-1])
    )
    sure = hands.visible[:, :, 0] & hands.known.all(1, keepdims=True)
    return np.asarray(sure & (own > RATIO * other) & (own - other > METRES))


def bone_lengths(hands: Hands) -> Float:
    """``[F, 2, 19]`` metres of palm and fingers, NaN where an end is not visible."""
    a, b = BONES.T
    lengths = np.linalg.norm(hands.p[:, :, a] - hands.p[:, :, b], axis=-1)
    return np.where(hands.visible[:, :, a] & hands.visible[:, :, b], lengths, np.nan)


def detections(subject: Subject, camera: str) -> Float | None:
    """``[F, 2, 21, 2]`` undistorted pixels of a camera's ``hands`` in landmarks2d, NaN = not found;
    None without such a file.

    Raises:
        DataError: when an array has another shape.
    """
    path = subject.layout.root / "landmarks2d" / f"{camera}.npz"
    arrays = read_arrays(path, ("hands", "frame_id")) if path.is_file() else {}
    if "hands" not in arrays:
        return None
    stored = expect_array(arrays, "hands", (None, 2 * HAND, 2), path)
    ids = whole_frame_ids(expect_array(arrays, "frame_id", (len(stored),), path), str(path))
    found = np.full((len(subject.frames), 2, HAND, 2), np.nan)
    for number, row in zip(ids.tolist(), stored, strict=True):
        if number in subject.rows:
            found[subject.rows[number]] = row.reshape(2, HAND, 2)
    return found


def exchanged_in(subject: Subject, name: str, hands: Hands, seen: Float) -> Bool:
    """``[F]`` frames in which a camera's detections ``[F, 2, 21, 2]`` of the two hands fit the
    hands in space better the other way round, in every hand that it saw."""
    camera = subject.cameras[name]
    pixels = project(camera, hands.p.reshape(len(hands.p), -1, 3))[0].reshape(seen.shape)
    pixels = np.where(hands.visible[..., None], pixels, np.nan)
    straight, across = (
        nanmedian(np.linalg.norm(seen - there, axis=-1).transpose(2, 0, 1))
        for there in (pixels, pixels[:, ::-1])
    )
    depth = project(camera, hands.wrists)[1].mean(1)
    apart = METRES * camera.K[0, 0] / np.maximum(depth, 1e-3)
    with np.errstate(invalid="ignore"):
        wrong = (straight > RATIO * across) & (straight - across > apart[:, None])
        known = np.isfinite(straight) & np.isfinite(across)
    return np.asarray(known.any(1) & (wrong | ~known).all(1))
