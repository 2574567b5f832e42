"""Doubtful frames, and the reasons: the skeleton over time, and masks of single images.

Convention: ``p [F, J, 3]`` metres, NaN where a joint is not visible, frames in rising order. What
cannot be measured (too few neighbours, joints not visible) is not flagged.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gsgan.check.report import Finding, listed
from gsgan.check.settings import Limits
from gsgan.check.views import CheckedData, MaskView, grouped
from gsgan.data.files import read_arrays
from gsgan.data.skeletons import bone_lengths
from gsgan.data.validation import spans
from gsgan.skeleton.template import SkeletonTemplate
from gsgan.utils.arrays import Bool, Float, expect_array, nanmedian

KINDS = {
    "outside": "joints lie outside the mask",
    "mask": "the mask is not of the body's size",
    "jump": "joints jump",
    "limb": "limbs change their length",
    "backwards": "nose or toes point backwards",
    "unseen": "few joints were seen",
    "detections": "joints lie far from their 2D detections",
}
# a jump exceeds the upper quartile of all by this: low frame rates pass
JUMP_RATIO = 4.0
# that a limb must be off as well: noise moves the ends of short bones
LIMB_METRES = 0.06
MIRRORED = 0.5  # share of frames facing backwards: then all of them are exchanged


@dataclass(frozen=True)
class Doubt:
    """A frame number and one reason to doubt it: a key of `KINDS`, and a text with numbers."""

    frame: int
    kind: str
    text: str


def skeleton_doubts(subject: CheckedData, limits: Limits) -> list[Doubt]:
    """Reasons to doubt the skeletons of all frames; no image is needed."""
    p = subject.seen_p
    template = subject.template
    names = template.names
    found = list[Doubt]()

    def doubt(
        kind: str, what: str, flags: Bool, text: Callable[[int, int], str]
    ) -> None:
        """Adds the frames in which any of the flags ``[F, N]`` holds."""
        for row in np.flatnonzero(flags.any(1)).tolist():
            texts = listed(
                [text(row, i) for i in np.flatnonzero(flags[row]).tolist()], 3
            )
            found.append(Doubt(int(subject.frames[row]), kind, f"{what}{texts}"))

    jump = jump_distance(p)
    gap = np.diff(subject.frames) != subject.step
    jump[1:][gap] = jump[:-1][gap] = np.nan  # neighbours in the list, not in time
    usual = float(np.quantile(np.nan_to_num(jump), 0.75))
    jumps = jumped(jump, max(limits.joint_jump, JUMP_RATIO * usual))
    doubt("jump", "jumps: ", jumps, lambda row, j: f"{names[j]} {jump[row, j]:.2f} m")

    lengths = bone_lengths(p, template.limbs)
    typical = nanmedian(lengths)
    change = np.abs(lengths - typical) / np.maximum(typical, 1e-6)
    bones = [f"{names[a]} to {names[b]}" for a, b in template.limbs]
    odd = (change > limits.limb_share) & (change * typical > LIMB_METRES)
    doubt(
        "limb",
        "length off its median: ",
        odd,
        lambda f, i: f"{bones[i]} {change[f, i]:.0%}",
    )

    backwards = facing(p, template)[:, None] < 0
    doubt("backwards", "", backwards, lambda *_: "nose or toes point backwards")

    seen = subject.visible.sum(1) / max(int(subject.visible.any(0).sum()), 1)
    few = seen[:, None] < limits.seen_share
    doubt("unseen", "", few, lambda row, _: f"{seen[row]:.0%} of the joints seen")
    pixels = reprojection_errors(subject)
    focal = float(np.median([camera.K[0, 0] for camera in subject.cameras.values()]))
    off = pixels > limits.reprojection * focal
    text = "{} {:.0f} px from 2D detections"
    doubt("detections", "", off, lambda row, j: text.format(names[j], pixels[row, j]))
    return found


def reprojection_errors(subject: CheckedData) -> Float:
    """``[F, J]`` pixels between projected joints and 2D detections, NaN where unknown.

    They are ``reproj_px`` of landmarks3d.npz, the mean over cameras, as `gsgan.prepare` writes it.

    Raises:
        DataError: when it has another shape than the joints.
    """
    result = np.full(subject.visible.shape, np.nan)
    path = subject.layout.root / "landmarks3d.npz"
    arrays = read_arrays(path, ("reproj_px", "frame_id")) if path.is_file() else {}
    if "reproj_px" in arrays:
        ids = expect_array(arrays, "frame_id", (None,), path)
        stored = expect_array(
            arrays, "reproj_px", (len(ids), len(subject.template.names)), path
        )
        for number, row in zip(ids.tolist(), stored, strict=True):
            if number in subject.rows:
                result[subject.rows[number]] = row
    return np.where(subject.visible, result, np.nan)


def mask_doubts(
    views: Sequence[MaskView], limits: Limits, unfit: Collection[str] = ()
) -> Iterable[Doubt]:
    """Reasons to doubt masks; those of ``unfit`` cameras do not fit in any frame."""
    for name, own in grouped(views).items():
        full = [view.fullness for view in own if view.mask.any()]
        usual = float(np.median(full)) if full else 0.0
        for view in own if name not in unfit else ():
            known = int(view.known.sum())
            out = int(view.beyond.sum())
            if not view.mask.any():
                yield Doubt(view.frame, "mask", f"{name}: the mask is empty")
                continue
            if known and out / known > limits.frame_outside:
                text = f"{name}: {out} of {known} joints outside the mask"
                yield Doubt(view.frame, "outside", text)
            change = view.fullness / usual - 1 if usual else 0.0
            # With few joints the estimated silhouette is too incomplete to compare the mask with.
            if (
                known >= limits.seen_share * len(view.known)
                and abs(change) > limits.area_jump
            ):
                text = f"{name}: mask area {change:+.0%} off the usual for the pose"
                yield Doubt(view.frame, "mask", text)


def frame_findings(
    subject: CheckedData, found: Sequence[Doubt], limits: Limits
) -> list[Finding]:
    """One finding per kind of doubt; an error when left and right, or most frames, are wrong."""
    findings = []
    count = len(subject.frames)
    backwards = sum(doubt.kind == "backwards" for doubt in found) / count
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
                f"{what} in {len(frames)} of {count} frames: {shortened(frames)} "
                f"(frame {some[0].frame}: {some[0].text})"
            )
            findings.append(Finding("warning", "frames", text))
    share = len({doubt.frame for doubt in found}) / count
    if share > limits.doubtful and not mirrored:
        text = f"{share:.0%} of the frames are doubtful; training on them is not worth its time"
        findings.append(Finding("error", "frames", text))
    return findings


def shortened(frames: Sequence[int], most: int = 8) -> str:
    """Frame numbers as ranges, the rest of a long list left out."""
    ranges = spans(list(frames)).split(", ")
    return ", ".join(ranges[:most]) + (" …" if len(ranges) > most else "")


def jump_distance(p: Float) -> Float:
    """``[F, J]`` metres from the midpoint of the joint's two neighbours in time; NaN if unknown.

    A steady motion gives 0 at any speed; the first and last frame are unknown.
    """
    distance = np.full(p.shape[:2], np.nan)
    distance[1:-1] = np.linalg.norm(p[1:-1] - (p[:-2] + p[2:]) / 2, axis=-1)
    return distance


def jumped(distance: Float, limit: float) -> Bool:
    """``[F, J]`` the peaks of `jump_distance` beyond the limit.

    A stray frame also moves its neighbours' midpoints, by half as much; only the peak counts.
    """
    known = np.pad(np.nan_to_num(distance), ((1, 1), (0, 0)))
    before = known[:-2]
    here = known[1:-1]
    after = known[2:]
    return np.asarray((here > limit) & (here >= before) & (here >= after))


def facing(p: Float, template: SkeletonTemplate) -> Float:
    """``[F]`` positive where nose and toes lie before the trunk, negative behind; NaN unknown.

    The trunk's front follows from its left and right; nose against ears and toes against ankles
    show the true one. All frames negative: left and right are exchanged throughout.
    """
    l_sh, r_sh, l_hip, r_hip = (p[:, j] for j in template.torso)
    front = np.cross(l_sh - r_sh, l_sh + r_sh - l_hip - r_hip)
    index = template.names.index
    ends = [(list(template.ears), template.nose)]
    ends += [
        ([index(f"{s}_ankle")], index(f"{s}_foot_index")) for s in ("left", "right")
    ]
    ahead = np.stack([p[:, tip] - p[:, behind].mean(1) for behind, tip in ends])
    votes = np.sign((ahead * front).sum(-1))
    known = np.isfinite(votes)
    votes = np.where(known, votes, 0.0).sum(0) / known.sum(0).clip(1)
    return np.where(known.any(0), votes, np.nan)
