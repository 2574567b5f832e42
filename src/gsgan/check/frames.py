"""Doubtful frames, and the reasons: the skeleton over time, and masks of single images.

Skeletons are ``p [F, J, 3]`` metres, NaN where a joint is not visible, frames in rising order. What
cannot be measured (too few neighbours, joints not visible) is not flagged.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gsgan.check.report import Finding, list_names
from gsgan.check.settings import Limits
from gsgan.check.views import CheckedData, MaskView, group_by_camera
from gsgan.data.skeletons import bone_lengths
from gsgan.data.validation import spans
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.joints import BODY, FLIP_GROUPS
from gsgan.skeleton.side_sequence import (
    EACH_GROUP,
    LABEL_COST,
    sides_of_sequence,
)
from gsgan.skeleton.template import SkeletonTemplate
from gsgan.utils.arrays import Bool, Float, expect_array, nanmedian
from gsgan.utils.pickles import read_arrays

# The kinds of doubts, with their text.
DOUBTS = {
    "outside": "joints lie outside the mask",
    "mask": "the mask is not of the body's size",
    "jump": "joints jump",
    "limb": "limbs change their length",
    "backwards": "nose or toes point backwards",
    "unseen": "few joints were seen",
    "detections": "joints lie far from their 2D detections",
}
# A jump exceeds the upper quartile of all by this factor: low frame rates pass.
JUMP_RATIO = 4.0
# Metres that a limb must be off as well: noise moves the ends of short bones.
LIMB_METRES = 0.06
# Share of frames facing backwards, above which left and right of all of them are exchanged.
MAX_BACKWARDS = 0.5
# The names of landmarks count as those of this many cameras.
SURE_LABELS = 2.0
USUAL_RATE = 30.0  # frames per second of a capture that does not state it
DOUBTED_PARTS = ("head", "arms", "legs")  # of `FLIP_GROUPS`


@dataclass(frozen=True)
class Doubt:
    """One reason to doubt a frame."""

    frame: int  # number
    kind: str  # a key of `DOUBTS`
    text: str  # with numbers


def skeleton_doubts(subject: CheckedData, limits: Limits) -> list[Doubt]:
    """Reasons to doubt the skeletons of all frames; no image is needed."""
    p = subject.seen_p
    template = subject.template
    names = template.names
    doubts = list[Doubt]()

    # Each kind of doubt is a table of flags by frame and joint.
    def doubt(
        kind: str,
        what: str,
        flags: Bool,
        text: Callable[[int, int], str],
    ) -> None:
        """Adds the frames in which any of the flags ``[F, N]`` holds."""
        # One doubt a frame, which lists the joints.
        for row in np.flatnonzero(flags.any(1)).tolist():
            texts = []
            for place in np.flatnonzero(flags[row]).tolist():
                texts.append(text(row, place))
            frame = int(subject.frames[row])
            doubts.append(Doubt(frame, kind, f"{what}{list_names(texts, 3)}"))

    # Jumps, unless neighbours in the list are not neighbours in time.
    jump = jump_distance(p)
    gap = np.diff(subject.frames) != subject.step
    jump[1:][gap] = np.nan
    jump[:-1][gap] = np.nan
    usual = float(np.quantile(np.nan_to_num(jump), 0.75))
    jumps = find_jumps(jump, max(limits.joint_jump, JUMP_RATIO * usual))
    doubt(
        "jump",
        "jumps: ",
        jumps,
        lambda row, joint: f"{names[joint]} {jump[row, joint]:.2f} m",
    )

    # Limbs that change their length.
    lengths = bone_lengths(p, template.limbs)  # [F, limbs]
    typical = nanmedian(lengths)
    change = np.abs(lengths - typical) / np.maximum(typical, 1e-6)
    changed = (change > limits.limb_share) & (change * typical > LIMB_METRES)
    bones = [f"{names[a]} to {names[b]}" for a, b in template.limbs]
    doubt(
        "limb",
        "length off its median: ",
        changed,
        lambda row, bone: f"{bones[bone]} {change[row, bone]:.0%}",
    )

    # Left and right exchanged.
    backwards = facing(p, template)[:, None] < 0  # [F, 1]
    doubt("backwards", "", backwards, lambda *_: "nose or toes point backwards")

    # Few of the joints that are ever seen.
    joints = int(subject.visible.any(0).sum())
    seen = subject.visible.sum(1) / max(joints, 1)
    few = seen[:, None] < limits.seen_share
    doubt(
        "unseen", "", few, lambda row, _: f"{seen[row]:.0%} of the joints seen"
    )

    # Joints far from 2D detections, as a share of the median focal length.
    pixels = reprojection_errors(subject)
    focal = np.median([camera.K[0, 0] for camera in subject.cameras.values()])
    text = "{} {:.0f} px from 2D detections"
    doubt(
        "detections",
        "",
        pixels > limits.reprojection * float(focal),
        lambda row, joint: text.format(names[joint], pixels[row, joint]),
    )
    return doubts


def find_exchanges(subject: CheckedData) -> Bool:
    """The groups ``[F, G]``, `FLIP_GROUPS`, whose left and right are exchanged for a time.

    Exchanged throughout is another finding: a motion without any change of sides has none here.
    """
    names = tuple(subject.template.names[:BODY])
    if names != MEDIAPIPE33.names:
        return np.zeros((len(subject.frames), len(FLIP_GROUPS)), bool)
    time = subject.frames / (subject.layout.meta.fps or USUAL_RATE)
    labels = np.full((len(time), len(FLIP_GROUPS)), SURE_LABELS * LABEL_COST)
    wrong = sides_of_sequence(subject.seen_p, labels, time, EACH_GROUP)
    return wrong & ~wrong.all(0)


def reprojection_errors(subject: CheckedData) -> Float:
    """Pixels ``[F, J]`` between projected joints and 2D detections, NaN if unknown.

    They are ``reproj_px`` of landmarks3d.npz, the mean over cameras, as `gsgan.prepare` writes it.

    Raises:
        DataError: if the array has another shape than the joints.
    """
    # Other datasets have no such file, or no such array in it.
    result = np.full(subject.visible.shape, np.nan)
    path = subject.layout.root / "landmarks3d.npz"
    if not path.is_file():
        return result
    arrays = read_arrays(path, ("reproj_px", "frame_id"))
    if "reproj_px" in arrays:
        ids = expect_array(arrays, "frame_id", (None,), path)
        shape = (len(ids), len(subject.template.names))
        stored = expect_array(arrays, "reproj_px", shape, path)
        for number, row in zip(ids.tolist(), stored, strict=True):
            # The file also has frames that were dropped.
            if number in subject.rows:
                result[subject.rows[number]] = row
    return np.where(subject.visible, result, np.nan)


def mask_doubts(
    views: Sequence[MaskView],
    limits: Limits,
    unfit: Collection[str] = (),
) -> Iterable[Doubt]:
    """Reasons to doubt masks, without the cameras ``unfit``, whose masks fit in no frame."""
    for name, camera_views in group_by_camera(views).items():
        if name in unfit:
            continue

        # The usual area of this camera's masks, relative to the body's.
        areas = [view.fullness for view in camera_views if view.mask.any()]
        usual = float(np.median(areas)) if areas else 0.0
        for view in camera_views:
            if not view.mask.any():
                yield Doubt(view.frame, "mask", f"{name}: the mask is empty")
                continue

            # Joints outside of the mask.
            joints = int(view.has_joint.sum())
            out = int(view.beyond.sum())
            if joints and out / joints > limits.frame_outside:
                text = f"{name}: {out} of {joints} joints outside the mask"
                yield Doubt(view.frame, "outside", text)

            # With few joints the estimated silhouette is too incomplete to compare the mask with.
            change = view.fullness / usual - 1 if usual else 0.0
            enough = joints >= limits.seen_share * len(view.has_joint)
            if enough and abs(change) > limits.area_jump:
                text = f"{name}: mask area {change:+.0%} off the usual for the pose"
                yield Doubt(view.frame, "mask", text)


def frame_findings(
    subject: CheckedData,
    doubts: Sequence[Doubt],
    limits: Limits,
) -> list[Finding]:
    """One finding per kind of doubt; an error if left and right, or most frames, are wrong."""
    findings = []
    count = len(subject.frames)
    by_kind: dict[str, list[Doubt]] = {}
    for doubt in doubts:
        by_kind.setdefault(doubt.kind, []).append(doubt)

    # Most frames face backwards: one error in place of many warnings.
    backwards = len(by_kind.get("backwards", [])) / count
    mirrored = backwards > MAX_BACKWARDS
    if mirrored:
        text = (
            f"in {backwards:.0%} of the frames nose and toes point backwards: the skeleton's left "
            "and right are exchanged, or images were mirrored"
        )
        findings.append(Finding("error", "skeleton", text))

    # Left and right exchanged for a time: an error with the frames of each part.
    if not mirrored:
        wrong = find_exchanges(subject)
        for part, flags in zip(DOUBTED_PARTS, wrong.T, strict=True):
            frames = subject.frames[flags].tolist()
            if frames:
                text = (
                    f"left and right of the {part} are exchanged in {len(frames)} of {count} "
                    f"frames: {format_ranges(frames)}; correct the landmarks, or leave these "
                    "frames out"
                )
                findings.append(Finding("error", "skeleton", text))

    # A warning per kind, with the first frame's text.
    for kind, what in DOUBTS.items():
        some = by_kind.get(kind)
        if some and not (mirrored and kind == "backwards"):
            frames = sorted({doubt.frame for doubt in some})
            text = (
                f"{what} in {len(frames)} of {count} frames: {format_ranges(frames)} "
                f"(frame {some[0].frame}: {some[0].text})"
            )
            findings.append(Finding("warning", "frames", text))

    # Most frames are doubtful for any reason.
    share = len({doubt.frame for doubt in doubts}) / count
    if share > limits.doubtful and not mirrored:
        text = f"{share:.0%} of the frames are doubtful; training on them is not worth its time"
        findings.append(Finding("error", "frames", text))
    return findings


def format_ranges(frames: Sequence[int], maximum: int = 8) -> str:
    """Frame numbers as ranges, the rest of a long list left out."""
    # Ranges count, not frames.
    ranges = spans(list(frames)).split(", ")
    text = ", ".join(ranges[:maximum])
    return f"{text} …" if len(ranges) > maximum else text


def jump_distance(p: Float) -> Float:
    """``[F, J]`` metres from the midpoint of the joint's two neighbours in time; NaN if unknown.

    A steady motion gives 0 at any speed; the first and last frame are unknown.
    """
    distance = np.full(p.shape[:2], np.nan)
    midpoint = (p[:-2] + p[2:]) / 2  # [F - 2, J, 3]
    distance[1:-1] = np.linalg.norm(p[1:-1] - midpoint, axis=-1)
    return distance


def find_jumps(distance: Float, limit: float) -> Bool:
    """``[F, J]`` whether `jump_distance` has a peak beyond the limit.

    A stray frame also moves its neighbours' midpoints, by half as much; only the peak counts.
    """
    # A row of zeros before and after: the first and last frame have one neighbour.
    padded = np.pad(np.nan_to_num(distance), ((1, 1), (0, 0)))

    # A tie counts as a peak: two equal jumps are both named.
    before = padded[:-2]
    here = padded[1:-1]
    after = padded[2:]
    peak = (here >= before) & (here >= after)
    return (here > limit) & peak


def facing(p: Float, template: SkeletonTemplate) -> Float:
    """Votes ``[F]``, positive if nose and toes lie before the trunk, negative behind; NaN unknown.

    The trunk's front follows from its left and right; nose against ears and toes against ankles
    show the true front. If all frames are negative, left and right are exchanged throughout.
    """
    # The trunk's front: from right to left, crossed with up.
    left_shoulder, right_shoulder, left_hip, right_hip = template.torso
    shoulders = p[:, left_shoulder] + p[:, right_shoulder]
    across = p[:, left_shoulder] - p[:, right_shoulder]
    front = np.cross(across, shoulders - p[:, left_hip] - p[:, right_hip])

    # The directions of face and feet.
    index = template.names.index
    ears = list(template.ears)
    ahead = [p[:, template.nose] - p[:, ears].mean(1)]
    for side in ("left", "right"):
        toe = p[:, index(f"{side}_foot_index")]
        ahead.append(toe - p[:, index(f"{side}_ankle")])

    # The mean of the known votes.
    votes = np.sign((np.stack(ahead) * front).sum(-1))  # [3, F]
    has_vote = np.isfinite(votes)
    votes = np.where(has_vote, votes, 0.0).sum(0) / has_vote.sum(0).clip(1)
    return np.where(has_vote.any(0), votes, np.nan)
