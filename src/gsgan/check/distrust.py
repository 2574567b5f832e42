"""Frames to distrust, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsgan.check.calibration import grouped
from gsgan.check.findings import Finding, listed
from gsgan.check.looking import Look
from gsgan.check.motion import (
    body_parts,
    facing,
    frozen,
    jump_distance,
    jumped,
    limb_lengths,
    measured_joints,
    odd_limbs,
    swapped,
)
from gsgan.check.reprojection import Reprojection, far_frames
from gsgan.check.settings import Limits
from gsgan.check.silhouette import Bool, Float
from gsgan.check.subject import Subject
from gsgan.data.checks import spans

SIDES = ("left", "top", "right", "bottom")
KINDS = {
    "outside": "joints lie outside the mask",
    "mask": "the mask is not of the body's size or place",
    "jump": "joints jump",
    "limb": "limbs change their length",
    "frozen": "joints stand exactly still, as gap filling leaves them",
    "exchanged": "left and right are exchanged",
    "backwards": "nose or toes point backwards",
    "unseen": "few joints were seen",
    "detections": "joints lie far from their 2D detections",
}
UPPER_QUARTILE = 0.75  # of all jumps: what is usual, jumping joints being few


@dataclass(frozen=True)
class Motion:
    """What the skeleton does from frame to frame, ``F`` frames.

    Args:
        jump: ``[F, J]`` metres from the middle of the neighbours in time.
        jumps: ``[F, J]`` which of them are too far.
        limb: ``[F, L]`` share by which a limb is off its median length.
        limbs: ``[F, L]`` which of them are too far off.
        frozen: ``[F, J]``.
        exchanged: ``[F]`` by body part.
        facing: ``[F]`` below 0 where the front looks backwards.
        seen: ``[F]`` share of the joints that any frame has.
    """

    jump: Float
    jumps: Bool
    limb: Float
    limbs: Bool
    frozen: Bool
    exchanged: dict[str, Bool]
    facing: Float
    seen: Float


def motion_of(subject: Subject, limits: Limits) -> Motion:
    """Judges the skeletons of all frames; no picture is needed."""
    p, visible, template = subject.p, subject.visible, subject.template
    jump = jump_distance(p, visible)
    gap = np.diff(subject.frames) != subject.step
    jump[1:][gap] = jump[:-1][gap] = np.nan  # neighbours in the list, not in time
    known = np.nan_to_num(jump)
    usual = float(np.quantile(known, UPPER_QUARTILE))
    jumps = jumped(jump, limits.joint_jump) & (known > limits.jump_ratio * usual)
    lengths = limb_lengths(p, visible, template)
    limbs, limb = odd_limbs(lengths, limits.limb_share, limits.limb_metres)
    still = frozen(p, visible, int(limits.frozen_frames))
    whole = np.asarray((still | ~visible).all(1) & still.any(1))
    measured = measured_joints(lengths, template, limits.rigid_share)
    return Motion(
        jump=jump,
        jumps=jumps,
        limb=limb,
        limbs=limbs,
        frozen=still & (measured | whole[:, None]),
        exchanged={
            name: swapped(p, visible, pairs, limits.swap_ratio, limits.swap_metres)
            for name, pairs in body_parts(template).items()
        },
        facing=facing(p, visible, template),
        seen=visible.sum(1) / max(int(visible.any(0).sum()), 1),
    )


@dataclass(frozen=True)
class Doubt:
    """A frame and one reason to distrust it.

    Args:
        frame: its number.
        kind: a key of `KINDS`.
        text: the reason, with numbers.
    """

    frame: int
    kind: str
    text: str


def doubts(
    subject: Subject,
    looks: Sequence[Look],
    motion: Motion,
    reprojection: Reprojection | None,
    limits: Limits,
    blamed: frozenset[str] = frozenset(),
) -> list[Doubt]:
    """Every reason to distrust a frame, in order of frames.

    Args:
        subject: the capture.
        looks: of the sampled pictures.
        motion: of `motion_of`.
        reprojection: or None.
        limits: what is too much.
        blamed: cameras whose calibration is wrong: their masks say nothing about frames.
    """
    found = [*_of_motion(subject, motion, limits)]
    if reprojection is not None:
        found += _of_detections(subject, reprojection, limits)
    for name, own in grouped(looks).items():
        if name not in blamed:
            full = [look.fullness for look in own if look.mask.any()]
            usual = float(np.median(full)) if full else 0.0
            for look in own:
                found += _of_look(look, usual, limits)
    return sorted(found, key=lambda doubt: doubt.frame)


def _of_motion(subject: Subject, motion: Motion, limits: Limits) -> list[Doubt]:
    names, limbs = subject.template.names, subject.template.limbs
    found = []
    for row, number in enumerate(map(int, subject.frames)):
        if motion.jumps[row].any():
            far = {names[j]: motion.jump[row, j] for j in np.flatnonzero(motion.jumps[row])}
            text = listed((f"{name} {metres:.2f} m" for name, metres in far.items()), 2)
            found.append(Doubt(number, "jump", f"jumps: {text}"))
        if motion.limbs[row].any():
            off = np.flatnonzero(motion.limbs[row])
            text = listed(
                (f"{names[limbs[i][0]]} to {names[limbs[i][1]]} {motion.limb[row, i]:.0%}"
                 for i in off), 2,
            )  # fmt: skip
            found.append(Doubt(number, "limb", f"length off its median: {text}"))
        if motion.frozen[row].any():
            text = listed((names[j] for j in np.flatnonzero(motion.frozen[row])), 2)
            found.append(Doubt(number, "frozen", f"frozen: {text}"))
        parts = [name for name, exchanged in motion.exchanged.items() if exchanged[row]]
        if parts:
            found.append(Doubt(number, "exchanged", f"left and right exchanged: {listed(parts)}"))
        if motion.facing[row] < 0:
            found.append(Doubt(number, "backwards", "nose or toes point backwards"))
        if motion.seen[row] < limits.seen_share:
            found.append(Doubt(number, "unseen", f"{motion.seen[row]:.0%} of the joints seen"))
    return found


def _of_detections(subject: Subject, reprojection: Reprojection, limits: Limits) -> list[Doubt]:
    medians, worst = far_frames(reprojection, limits)
    found = []
    for row, number in enumerate(map(int, subject.frames)):
        if not np.isnan(worst[row]):
            joint = subject.template.names[int(np.nanargmax(reprojection.pixels[row]))]
            text = f"{joint} {worst[row]:.0f} px from its detections"
            found.append(Doubt(number, "detections", text))
        elif not np.isnan(medians[row]):
            text = f"joints {medians[row]:.0f} px from their detections"
            found.append(Doubt(number, "detections", text))
    return found


def _of_look(look: Look, usual: float, limits: Limits) -> list[Doubt]:
    if not look.mask.any():
        return [Doubt(look.frame, "mask", f"{look.camera}: the mask is empty")]
    found = []
    judged, out = int(look.judged.sum()), int(look.beyond(limits).sum())
    if judged and out / judged > limits.frame_outside:
        text = f"{look.camera}: {out} of {judged} joints outside the mask"
        found.append(Doubt(look.frame, "outside", text))
    if judged < limits.seen_share * len(look.judged):
        return found  # too little of the body is foretold to hold the mask against
    change = look.fullness / usual - 1 if usual else 0.0
    if abs(change) > limits.area_jump:
        text = f"{look.camera}: mask area {change:+.0%} off what is usual for the pose"
        found.append(Doubt(look.frame, "mask", text))
    side = int(np.nan_to_num(np.abs(look.reach)).argmax())
    if abs(look.reach[side]) > limits.box_reach:
        way = "beyond" if look.reach[side] > 0 else "short of"
        text = f"{look.camera}: mask ends {abs(look.reach[side]):.2f} m {way} the body"
        found.append(Doubt(look.frame, "mask", f"{text} ({SIDES[side]})"))
    return found


def judge_doubts(
    subject: Subject, found: Sequence[Doubt], motion: Motion, limits: Limits
) -> list[Finding]:
    """One finding a kind of doubt; an error when left and right, or most frames, are wrong."""
    findings = []
    known = motion.facing[~np.isnan(motion.facing)]
    mirrored = len(known) > 0 and float((known < 0).mean()) > limits.mirrored
    if mirrored:
        findings.append(
            Finding(
                "error", "skeleton",
                f"in {(known < 0).mean():.0%} of the frames nose and toes point backwards: the "
                "skeleton's left and right are exchanged, or a camera image was mirrored",
            )
        )  # fmt: skip
    for kind, what in KINDS.items():
        frames = sorted({doubt.frame for doubt in found if doubt.kind == kind})
        if frames and not (mirrored and kind == "backwards"):
            some = next(doubt for doubt in found if doubt.kind == kind)
            findings.append(
                Finding(
                    "warning", "frames",
                    f"{what} in {len(frames)} of {len(subject.frames)} frames: {shortened(frames)} "
                    f"(frame {some.frame}: {some.text})",
                )
            )  # fmt: skip
    doubtful = {doubt.frame for doubt in found}
    share = len(doubtful) / len(subject.frames)
    if share > limits.distrust and not mirrored:
        findings.append(
            Finding(
                "error", "frames",
                f"{share:.0%} of the frames are doubtful; training on them is not worth its time",
            )
        )  # fmt: skip
    return findings


def shortened(frames: Sequence[int], most: int = 8) -> str:
    """Frame numbers as ranges, the rest of a long list left out."""
    ranges = spans(list(frames)).split(", ")
    return ", ".join(ranges[:most]) + (" …" if len(ranges) > most else "")
