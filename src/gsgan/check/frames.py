"""Doubtful frames, and the reasons: the skeleton over time, and masks of single images.

Convention: ``p [F, J, 3]`` metres, ``visible [F, J]``, frames in rising order. What cannot be
measured (too few neighbours, joints not visible) is not flagged.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_opening

from gsgan.check.report import Finding, listed
from gsgan.check.settings import Limits
from gsgan.check.views import Subject, View, grouped, nanmedian
from gsgan.data.files import read_arrays
from gsgan.data.formats.consistency import Bool, Float
from gsgan.data.validation import spans
from gsgan.skeleton.template import SkeletonTemplate
from gsgan.utils.arrays import expect_array

KINDS = {
    "outside": "joints lie outside the mask",
    "mask": "the mask is not of the body's size",
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
STILL = 1e-6  # metres: measured joints never repeat this closely
SWAP_RATIO = 2.0  # exchanged sides must be this many times nearer to where they were
SWAP_METRES = 0.06  # and this much nearer: crossing feet come close


@dataclass(frozen=True)
class Doubt:
    """A frame number and one reason to doubt it: a key of `KINDS`, and a text with numbers."""

    frame: int
    kind: str
    text: str


@dataclass(frozen=True)
class Motion:
    """What the skeleton does over time, ``F`` frames.

    Args:
        jump: ``[F, J]`` metres from the midpoint of the neighbours in time.
        facing: ``[F]`` below 0 where the front points backwards.
        seen: ``[F]`` share of the joints that any frame has.
        reprojection: ``[F, J]`` of `reprojection_errors`.
        doubts: by kind.
    """

    jump: Float
    facing: Float
    seen: Float
    reprojection: Float
    doubts: tuple[Doubt, ...]


def motion_of(subject: Subject, limits: Limits) -> Motion:
    """Measures the skeletons of all frames; no image is needed."""
    p, visible, template = subject.p, subject.visible, subject.template
    names, found = template.names, list[Doubt]()

    def doubt(kind: str, what: str, flags: Bool, text: Callable[[int, int], str]) -> None:
        """Adds the frames in which any of the flags ``[F, N]`` holds."""
        for row in np.flatnonzero(flags.any(1)).tolist():
            texts = listed([text(row, i) for i in np.flatnonzero(flags[row]).tolist()], 3)
            found.append(Doubt(int(subject.frames[row]), kind, f"{what}{texts}"))

    jump = jump_distance(p, visible)
    gap = np.diff(subject.frames) != subject.step
    jump[1:][gap] = jump[:-1][gap] = np.nan  # neighbours in the list, not in time
    usual = float(np.quantile(np.nan_to_num(jump), 0.75))
    jumps = jumped(jump, limits.joint_jump) & (np.nan_to_num(jump) > JUMP_RATIO * usual)
    doubt("jump", "jumps: ", jumps, lambda row, j: f"{names[j]} {jump[row, j]:.2f} m")
    lengths = limb_lengths(p, visible, template)
    change = length_change(lengths)
    bones = [f"{names[a]} to {names[b]}" for a, b in template.limbs]
    odd = (change > limits.limb_share) & (change * nanmedian(lengths) > LIMB_METRES)
    doubt("limb", "length off its median: ", odd, lambda f, i: f"{bones[i]} {change[f, i]:.0%}")
    still = frozen(p, visible, int(limits.frozen_frames))
    whole = np.asarray((still | ~visible).all(1) & still.any(1))
    still &= measured_joints(change, template, RIGID) | whole[:, None]
    doubt("frozen", "frozen: ", still, lambda _, j: names[j])
    parts = body_parts(template)
    exchanged = np.stack([swapped(p, visible, pairs) for pairs in parts.values()], 1)
    doubt("exchanged", "left and right exchanged: ", exchanged, lambda _, i: list(parts)[i])
    front = facing(p, visible, template)
    doubt("backwards", "", front[:, None] < 0, lambda *_: "nose or toes point backwards")
    seen = visible.sum(1) / max(int(visible.any(0).sum()), 1)
    few = seen[:, None] < limits.seen_share
    doubt("unseen", "", few, lambda row, _: f"{seen[row]:.0%} of the joints seen")
    pixels = reprojection_errors(subject)
    focal = float(np.median([camera.K[0, 0] for camera in subject.cameras.values()]))
    off = pixels > limits.reprojection_joint * focal
    away = "px from 2D detections"
    doubt("detections", "", off, lambda row, j: f"{names[j]} {pixels[row, j]:.0f} {away}")
    median = nanmedian(pixels.T)
    many = (median > limits.reprojection_frame * focal) & ~off.any(1)
    doubt("detections", "", many[:, None], lambda row, _: f"joints {median[row]:.0f} {away}")
    return Motion(jump, front, seen, pixels, tuple(found))


def reprojection_errors(subject: Subject) -> Float:
    """``[F, J]`` pixels between projected joints and 2D detections, NaN where unknown.

    They are ``reproj_px`` of landmarks3d.npz, the mean over cameras, as `gsgan.prepare` writes it.

    Raises:
        DataError: when it has another shape than the joints.
    """
    result = np.full(subject.visible.shape, np.nan)
    path = subject.layout.root / "landmarks3d.npz"
    if not path.is_file():
        return result
    arrays = read_arrays(path, ("reproj_px", "frame_id"))
    if "reproj_px" in arrays:
        ids = expect_array(arrays, "frame_id", (None,), path)
        stored = expect_array(arrays, "reproj_px", (len(ids), subject.p.shape[1]), path)
        for number, row in zip(ids, stored, strict=True):
            if int(number) in subject.rows:
                result[subject.rows[int(number)]] = row
    return np.where(subject.visible & np.isfinite(result), result, np.nan)


def doubts(
    subject: Subject,
    views: Sequence[View],
    motion: Motion,
    limits: Limits,
    unfit: Collection[str] = (),
) -> list[Doubt]:
    """Every reason to doubt a frame, in order of frames.

    Masks of ``unfit`` cameras are not used: they do not fit in any frame.
    """
    found = list(motion.doubts)
    for name, own in grouped(views).items():
        full = [view.fullness for view in own if view.mask.any()]
        usual = float(np.median(full)) if full else 0.0
        for view in own if name not in unfit else ():
            found += [Doubt(view.frame, *doubt) for doubt in _of_view(view, usual, limits)]
    return sorted(found, key=lambda doubt: doubt.frame)


def _of_view(view: View, usual: float, limits: Limits) -> Iterable[tuple[str, str]]:
    known, out = int(view.known.sum()), int(view.beyond.sum())
    if not view.mask.any():
        yield "mask", f"{view.camera}: the mask is empty"
        return
    if known and out / known > limits.frame_outside:
        yield "outside", f"{view.camera}: {out} of {known} joints outside the mask"
    change = view.fullness / usual - 1 if usual else 0.0
    # else the estimated silhouette is too incomplete to compare the mask with
    if known >= limits.seen_share * len(view.known) and abs(change) > limits.area_jump:
        yield "mask", f"{view.camera}: mask area {change:+.0%} off the usual for the pose"


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
            "and right are exchanged, or images were mirrored"
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


def jump_distance(p: Float, visible: Bool) -> Float:
    """``[F, J]`` metres from the midpoint of the joint's two neighbours in time; NaN if unknown.

    A steady motion gives 0 at any speed; the first and last frame are unknown.
    """
    distance = np.full(p.shape[:2], np.nan)
    if len(p) > 2:
        middle = (p[:-2] + p[2:]) / 2
        seen = visible[:-2] & visible[1:-1] & visible[2:]
        distance[1:-1] = np.where(seen, np.linalg.norm(p[1:-1] - middle, axis=-1), np.nan)
    return distance


def jumped(distance: Float, limit: float) -> Bool:
    """``[F, J]`` the peaks of `jump_distance` beyond the limit.

    A stray frame also moves its neighbours' midpoints, by half as much; only the peak counts.
    """
    known = np.nan_to_num(distance)
    before, after = np.zeros_like(known), np.zeros_like(known)
    before[1:], after[:-1] = known[:-1], known[1:]
    return (known > limit) & (known >= before) & (known >= after)


def limb_lengths(p: Float, visible: Bool, template: SkeletonTemplate) -> Float:
    """``[F, L]`` metres, NaN where an end is not visible."""
    a, b = np.array(template.limbs).T
    lengths = np.linalg.norm(p[:, a] - p[:, b], axis=-1)
    return np.where(visible[:, a] & visible[:, b], lengths, np.nan)


def length_change(lengths: Float) -> Float:
    """``[F, L]`` share by which limbs differ from their median length; NaN if unknown."""
    typical = nanmedian(lengths)
    return np.asarray(np.abs(lengths - typical) / np.maximum(typical, STILL))


def measured_joints(change: Float, template: SkeletonTemplate, share: float) -> Bool:
    """``[J]`` joints with a bone whose `length_change` exceeds ``share`` in some frame.

    The bones of a posed body model keep their length, measured ones do not.
    """
    measured = np.zeros(len(template.names), bool)
    measured[np.array(template.limbs)[(np.nan_to_num(change) > share).any(0)]] = True
    return measured


def frozen(p: Float, visible: Bool, least: int) -> Bool:
    """``[F, J]`` joints that stand exactly still for at least ``least`` frames in a row.

    Gap filling and copied frames do this; measured joints never do, computed ones may.
    """
    same = np.zeros(visible.shape, bool)
    same[1:] = np.linalg.norm(p[1:] - p[:-1], axis=-1) < STILL
    same[1:] &= visible[1:] & visible[:-1]
    # an opening keeps runs of equal steps; a run of n joins n + 1 frames
    held = binary_opening(same, np.ones((max(1, least - 1), 1)))
    held[:-1] |= held[1:].copy()
    return np.asarray(held)


def body_parts(template: SkeletonTemplate) -> dict[str, tuple[tuple[int, int], ...]]:
    """(left, right) joints that would be exchanged together, by the part's name."""
    parts = {"face": set(template.face)}
    for name, roots in (("arms", template.shoulders), ("legs", template.hips)):
        parts[name] = set(roots)
        for _ in template.limbs:  # every joint that hangs on the roots
            parts[name] |= {b for a, b in template.limbs if a in parts[name]}
    pairs = [(a, b) for a, b in enumerate(template.mirror) if "left" in template.names[a]]
    return {name: tuple(p for p in pairs if p[0] in joints) for name, joints in parts.items()}


def swapped(
    p: Float, visible: Bool, pairs: tuple[tuple[int, int], ...], metres: float = SWAP_METRES
) -> Bool:
    """``[F]`` frames in which a body part's left and right are exchanged.

    From frame to frame the part is exchanged where exchanging brings it nearer to where it was:
    mean distance `SWAP_RATIO` times and ``metres`` less. The smaller half of the frames that
    these exchanges separate counts as wrong. ``pairs`` are (left, right) joints of the part.
    """
    state = np.zeros(len(p), bool)
    if not pairs or len(p) < 3:
        return state
    sides = np.array(pairs).T
    both = visible[:, sides[0]] & visible[:, sides[1]]
    last: int | None = None
    for f in range(len(p)):
        if last is not None:
            state[f] = state[last]
        if not both[f].any():
            continue
        if last is not None and (shared := both[f] & both[last]).any():
            now, then = p[f, sides[:, shared]], p[last, sides[:, shared]]
            straight = np.linalg.norm(now - then, axis=-1).sum(0)
            across = np.linalg.norm(now - then[::-1], axis=-1).sum(0)
            gain = (straight - across).mean() / 2
            state[f] ^= straight.mean() > SWAP_RATIO * across.mean() and gain > metres
        last = f
    return state if state.mean() <= 0.5 else ~state


def facing(p: Float, visible: Bool, template: SkeletonTemplate) -> Float:
    """``[F]`` positive where nose and toes lie before the trunk, negative behind; NaN unknown.

    The trunk's front follows from its left and right; nose against ears and toes against ankles
    show the true one. All frames negative: left and right are exchanged throughout.
    """
    l_sh, r_sh, l_hip, r_hip = (p[:, j] for j in template.torso)
    front = np.cross(l_sh - r_sh, l_sh + r_sh - l_hip - r_hip)
    trunk = visible[:, list(template.torso)].all(1)
    index = template.names.index
    ends = [(list(template.ears), template.nose)]
    ends += [([index(f"{s}_ankle")], index(f"{s}_foot_index")) for s in ("left", "right")]
    votes = np.full((len(ends), len(p)), np.nan)
    for vote, (behind, ahead) in zip(votes, ends, strict=True):
        seen = trunk & visible[:, [*behind, ahead]].all(1)
        direction = p[:, ahead] - p[:, behind].mean(1)
        vote[seen] = np.sign((direction * front).sum(-1))[seen]
    count = (~np.isnan(votes)).sum(0)
    return np.where(count > 0, np.nansum(votes, axis=0) / np.maximum(count, 1), np.nan)
