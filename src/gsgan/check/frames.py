"""Doubtful frames, and the reasons."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gsgan.check.motion import (
    body_parts,
    facing,
    frozen,
    jump_distance,
    jumped,
    length_change,
    limb_lengths,
    measured_joints,
    nanmedian,
    swapped,
)
from gsgan.check.report import Finding, listed
from gsgan.check.reprojection import Reprojection
from gsgan.check.settings import Limits
from gsgan.check.views import Subject, View, grouped
from gsgan.data.checks import spans
from gsgan.data.formats.trust import Bool, Float

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
JUMP_RATIO = 4.0  # a jump exceeds the upper quartile of all by this: low frame rates pass
LIMB_METRES = 0.06  # that a limb must be off as well: noise moves the ends of short bones
RIGID = 0.05  # a joint whose bones change less is a computed one, which may stand still
MIRRORED = 0.5  # share of frames facing backwards: then all of them are exchanged


@dataclass(frozen=True)
class Motion:
    """What the skeleton does over time, ``F`` frames.

    Args:
        jump: ``[F, J]`` metres from the midpoint of the neighbours in time.
        jumps: ``[F, J]`` which of them are too large.
        change: ``[F, L]`` share by which a limb differs from its median length.
        limbs: ``[F, L]`` which of them are too large.
        frozen: ``[F, J]``.
        exchanged: ``[F]`` by body part.
        facing: ``[F]`` below 0 where the front points backwards.
        seen: ``[F]`` share of the joints that any frame has.
    """

    jump: Float
    jumps: Bool
    change: Float
    limbs: Bool
    frozen: Bool
    exchanged: dict[str, Bool]
    facing: Float
    seen: Float


def motion_of(subject: Subject, limits: Limits) -> Motion:
    """Measures the skeletons of all frames; no image is needed."""
    p, visible, template = subject.p, subject.visible, subject.template
    jump = jump_distance(p, visible)
    gap = np.diff(subject.frames) != subject.step
    jump[1:][gap] = jump[:-1][gap] = np.nan  # neighbours in the list, not in time
    usual = float(np.quantile(np.nan_to_num(jump), 0.75))
    lengths = limb_lengths(p, visible, template)
    change = length_change(lengths)
    still = frozen(p, visible, int(limits.frozen_frames))
    whole = np.asarray((still | ~visible).all(1) & still.any(1))
    return Motion(
        jump=jump,
        jumps=jumped(jump, limits.joint_jump) & (np.nan_to_num(jump) > JUMP_RATIO * usual),
        change=change,
        limbs=(change > limits.limb_share) & (change * nanmedian(lengths) > LIMB_METRES),
        frozen=still & (measured_joints(change, template, RIGID) | whole[:, None]),
        exchanged={n: swapped(p, visible, pairs) for n, pairs in body_parts(template).items()},
        facing=facing(p, visible, template),
        seen=visible.sum(1) / max(int(visible.any(0).sum()), 1),
    )


@dataclass(frozen=True)
class Doubt:
    """A frame and one reason to doubt it.

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
    views: Sequence[View],
    motion: Motion,
    reprojection: Reprojection | None,
    limits: Limits,
    unfit: frozenset[str] = frozenset(),
) -> list[Doubt]:
    """Every reason to doubt a frame, in order of frames.

    Args:
        subject: the dataset.
        views: of the sampled images.
        motion: of `motion_of`.
        reprojection: or None.
        limits: thresholds.
        unfit: cameras whose masks do not fit as a whole: they are not used for single frames.
    """
    found = []
    for row, number in enumerate(map(int, subject.frames)):
        found += [Doubt(number, *doubt) for doubt in _of_motion(subject, motion, row, limits)]
        if reprojection is not None and (
            text := _of_detections(subject, reprojection, row, limits)
        ):
            found.append(Doubt(number, "detections", text))
    for name, own in grouped(views).items():
        if name not in unfit:
            full = [view.fullness for view in own if view.mask.any()]
            usual = float(np.median(full)) if full else 0.0
            found += [
                Doubt(view.frame, kind, f"{name}: {text}")
                for view in own
                for kind, text in _of_view(view, usual, limits)
            ]
    return sorted(found, key=lambda doubt: doubt.frame)


def _of_motion(
    subject: Subject, motion: Motion, row: int, limits: Limits
) -> Iterable[tuple[str, str]]:
    names, limbs = subject.template.names, subject.template.limbs
    if motion.jumps[row].any():
        far = np.flatnonzero(motion.jumps[row])
        yield (
            "jump",
            "jumps: " + listed([f"{names[j]} {motion.jump[row, j]:.2f} m" for j in far], 2),
        )
    if motion.limbs[row].any():
        off = [
            f"{names[limbs[i][0]]} to {names[limbs[i][1]]} {motion.change[row, i]:.0%}"
            for i in np.flatnonzero(motion.limbs[row])
        ]
        yield "limb", f"length off its median: {listed(off, 2)}"
    if motion.frozen[row].any():
        still = [names[j] for j in np.flatnonzero(motion.frozen[row])]
        yield "frozen", f"frozen: {listed(still, 2)}"
    if parts := [name for name, exchanged in motion.exchanged.items() if exchanged[row]]:
        yield "exchanged", f"left and right exchanged: {listed(parts)}"
    if motion.facing[row] < 0:
        yield "backwards", "nose or toes point backwards"
    if motion.seen[row] < limits.seen_share:
        yield "unseen", f"{motion.seen[row]:.0%} of the joints seen"


def _of_detections(
    subject: Subject, reprojection: Reprojection, row: int, limits: Limits
) -> str | None:
    pixels, focal = reprojection.pixels[row], reprojection.focal
    if np.isnan(pixels).all():
        return None
    worst = int(np.nanargmax(pixels))
    if pixels[worst] > limits.reprojection_joint * focal:
        return f"{subject.template.names[worst]} {pixels[worst]:.0f} px from its detections"
    if (median := float(np.nanmedian(pixels))) > limits.reprojection_frame * focal:
        return f"joints {median:.0f} px from their detections"
    return None


def _of_view(view: View, usual: float, limits: Limits) -> Iterable[tuple[str, str]]:
    if not view.mask.any():
        yield "mask", "the mask is empty"
        return
    known, out = int(view.known.sum()), int(view.beyond.sum())
    if known and out / known > limits.frame_outside:
        yield "outside", f"{out} of {known} joints outside the mask"
    if known < limits.seen_share * len(view.known):
        return  # the estimated silhouette is too incomplete to compare the mask with
    change = view.fullness / usual - 1 if usual else 0.0
    if abs(change) > limits.area_jump:
        yield "mask", f"mask area {change:+.0%} off the usual for the pose"
    side = int(np.nan_to_num(np.abs(view.reach)).argmax())
    if abs(view.reach[side]) > limits.box_reach:
        way = "beyond" if view.reach[side] > 0 else "short of"
        metres = abs(view.reach[side])
        yield "mask", f"mask ends {metres:.2f} m {way} the body ({SIDES[side]})"


def frame_findings(
    subject: Subject, found: Sequence[Doubt], motion: Motion, limits: Limits
) -> list[Finding]:
    """One finding per kind of doubt; an error when left and right, or most frames, are wrong."""
    findings = []
    known = motion.facing[~np.isnan(motion.facing)]
    backwards = float((known < 0).mean()) if len(known) else 0.0
    mirrored = backwards > MIRRORED
    if mirrored:
        text = (
            f"in {backwards:.0%} of the frames nose and toes point backwards: the skeleton's left "
            "and right are exchanged, or a camera image was mirrored"
        )
        findings.append(Finding("error", "skeleton", text))
    for kind, what in KINDS.items():
        some = [doubt for doubt in found if doubt.kind == kind]
        if some and not (mirrored and kind == "backwards"):
            frames = sorted({doubt.frame for doubt in some})
            text = (
                f"{what} in {len(frames)} of {len(subject.frames)} frames: {shortened(frames)} "
                f"(frame {some[0].frame}: {some[0].text})"
            )
            findings.append(Finding("warning", "frames", text))
    share = len({doubt.frame for doubt in found}) / len(subject.frames)
    if share > limits.distrust and not mirrored:
        text = f"{share:.0%} of the frames are doubtful; training on them is not worth its time"
        findings.append(Finding("error", "frames", text))
    return findings


def shortened(frames: Sequence[int], most: int = 8) -> str:
    """Frame numbers as ranges, the rest of a long list left out."""
    ranges = spans(list(frames)).split(", ")
    return ", ".join(ranges[:most]) + (" …" if len(ranges) > most else "")
