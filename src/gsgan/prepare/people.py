"""One person of several: the same one in all cameras, by geometry and by the frame before."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations, pairwise, product
from typing import NamedTuple

import numpy as np

from gsgan.data.cameras import CameraEntry
from gsgan.prepare.camera_array import CameraArray, undistort_points
from gsgan.prepare.landmarks import Detections
from gsgan.prepare.triangulate import plain
from gsgan.skeleton import MEDIAPIPE33
from gsgan.skeleton.joints import BODY, is_known
from gsgan.skeleton.proportions import HIPS, SHOULDERS
from gsgan.utils.arrays import Float
from gsgan.utils.errors import DataError

# Median reprojection error, thousandths of the focal length, above which two cameras show two
# people: 15 cm at 3 m.
SAME_PERSON = 50.0
# Joints that a person has in common with another camera or another frame.
MIN_COMMON_JOINTS = 6
# Steps from frame to frame, in sizes of the person: those of up to this many times the usual step,
# and of at least this size, cost nothing.
USUAL_STEPS = 3.0
SMALL_STEP = 0.05
MAX_FAILED = 0.5  # share of the frames with several people in which no two cameras may agree


# Metres, and metres a second, above which a person from frame to frame is another one.
MAX_JUMP = 0.5
MAX_SPEED = 12.0
STAYS = 3  # frames before and after a jump, of which all must be apart
# Share by which half of the limbs must differ in length for another person; detections of one
# person differ by up to 3 % from clip to clip.
OTHER_LENGTHS = 0.05
MIN_CLIP = 10  # frames with which a limb is measured
# Limbs as pairs of joints, whose two sides are alike.
LENGTHS = (
    ((11, 13), (12, 14)),
    ((13, 15), (14, 16)),
    ((23, 25), (24, 26)),
    ((25, 27), (26, 28)),
    (SHOULDERS,),
    (HIPS,),
)


class _Group(NamedTuple):
    """One person in one frame."""

    chosen: tuple[
        int, ...
    ]  # number of the person in each camera, -1 = not seen
    p: Float  # [33, 3] joints, NaN = not seen
    size: float  # diagonal of the joints' box, in the unit of the cameras
    confidence: float  # sum over cameras and joints


def one_person(
    detections: Mapping[str, Detections],
    cameras: Sequence[CameraEntry],
    offsets: Mapping[str, int],
) -> tuple[dict[str, Detections], list[str]]:
    """Detections of one person, the same in all cameras, and a note where there were several.

    In each frame the people of all cameras are joined to groups that one 3D person explains. Of the
    ways through the groups of all frames, the one with the most confidence and the shortest steps
    is taken. Where no two cameras agree, nobody was seen.

    Args:
        detections: by camera, with all ``people`` where there were several.
        cameras: calibrated, in the same order.
        offsets: frames to add to the numbers of a camera.

    Raises:
        DataError: when the people of the cameras can hardly ever be joined.
    """
    several = find_crowds(detections, offsets)
    if not several:
        return dict(detections), []

    # All people of a frame, by camera: rays need pixels without distortion.
    rig = CameraArray.of(cameras)
    rows = {}
    for name, detected in detections.items():
        offset = int(offsets.get(name, 0))
        numbers = (detected.frame_id + offset).tolist()
        rows[name] = dict(zip(numbers, range(len(numbers)), strict=True))
    frames = sorted(set().union(*rows.values()))
    steps = []
    for frame in frames:
        people = []
        for camera, (name, detected) in zip(
            cameras, detections.items(), strict=True
        ):
            row = rows[name].get(frame)
            people.append(_people(camera, detected, row))
        steps.append(_groups(rig, people))

    # The way through all frames, and who is taken in each camera.
    way = _way(steps)
    failed = [f for f, group in zip(frames, way, strict=True) if group is None]
    failed = sorted(several & set(failed))
    text = f"several people were detected in {len(several)} of {len(frames)} frames"
    if len(failed) > MAX_FAILED * len(several):
        raise DataError(
            f"{text}, and in {len(failed)} of them no two cameras agree on one person; leave one "
            "person in each file of landmarks"
        )
    result = {}
    for c, (name, detected) in enumerate(detections.items()):
        chosen = {}
        for frame, group in zip(frames, way, strict=True):
            if frame in rows[name] and (group is not None or frame in several):
                person = -1 if group is None else group.chosen[c]
                chosen[rows[name][frame]] = person
        result[name] = _only(detected, chosen)
    note = f"{text}; the one that all cameras agree on was taken"
    if failed:
        note += f", and nobody in {len(failed)} frames in which they do not"
    return result, [note]


def find_crowds(
    detections: Mapping[str, Detections], offsets: Mapping[str, int]
) -> set[int]:
    """The common numbers of frames in which any camera shows several people."""
    several: set[int] = set()
    for name, detected in detections.items():
        offset = int(offsets.get(name, 0))
        several.update(number + offset for number in detected.crowded)
    return several


def find_jumps(p: Float, time: Float) -> list[int]:
    """The rows of joints ``p [F, J, 3]``, metres, before which the person jumps, to stay there.

    Args:
        p: NaN = not seen.
        time: ``[F]`` seconds.
    """
    rows = np.flatnonzero(is_known(p).sum(1) >= MIN_COMMON_JOINTS)
    jumps = []
    for k in range(1, len(rows) - STAYS + 1):
        before = p[rows[max(0, k - STAYS) : k]]
        after = p[rows[k : k + STAYS]]
        seconds = time[rows[k]] - time[rows[k - 1]]
        reach = max(MAX_JUMP, MAX_SPEED * seconds)
        apart = [_move(*pair) for pair in product(before, after)]
        if min(apart) > reach:
            jumps.append(int(rows[k]))
    return jumps


def compare_people(p: Float, jumps: Sequence[int]) -> dict[int, float]:
    """By which share limbs are longer or shorter after each jump of a person, in the median.

    Args:
        p: ``[F, J, 3]``, NaN = not seen.
        jumps: of `find_jumps`; those with too few frames before or after are left out.
    """
    lengths = _limb_lengths(p)
    shares = {}
    for start, row, stop in zip(
        (0, *jumps[:-1]), jumps, (*jumps[1:], len(p)), strict=True
    ):
        ratios = []
        for length in lengths:
            before = length[start:row][np.isfinite(length[start:row])]
            after = length[row:stop][np.isfinite(length[row:stop])]
            if min(len(before), len(after)) >= MIN_CLIP:
                ratios.append(np.median(after) / np.median(before))
        if 2 * len(ratios) >= len(lengths):
            shares[row] = float(np.median(np.abs(np.log(ratios))))
    return shares


def _limb_lengths(p: Float) -> list[Float]:
    """The length ``[F]`` of each of `LENGTHS` in joints ``[F, J, 3]``; NaN = not seen."""
    lengths = []
    for sides in LENGTHS:
        ends = np.stack([p[:, b] - p[:, a] for a, b in sides])
        lengths.append(np.linalg.norm(ends, axis=-1).mean(0))
    return lengths


def _move(before: Float, after: Float) -> float:
    """The distance between two poses ``[J, 3]``, by the joints of both; 0 without any."""
    apart = after - before
    both = apart[is_known(apart)]
    if not len(both):
        return 0.0
    return float(np.linalg.norm(np.median(both, axis=0)))


def _only(detections: Detections, chosen: Mapping[int, int]) -> Detections:
    """Detections with the person of a number, -1 for nobody, in each row that is listed."""
    px = detections.px.copy()
    conf = detections.conf.copy()
    for row, person in chosen.items():
        if person < 0:
            px[row] = np.nan
            conf[row] = 0.0
        elif detections.people is not None:
            px[row], conf[row] = detections.people[row][person]
    return replace(detections, px=px, conf=conf, people=None)


def _people(
    camera: CameraEntry, detections: Detections, row: int | None
) -> list[tuple[Float, Float]]:
    """Undistorted pixels ``[33, 2]`` and confidence ``[33]`` of each person in a frame."""
    if row is None:
        return []
    alone = [(detections.px[row], detections.conf[row])]
    people = alone if detections.people is None else detections.people[row]
    result = []
    for px, conf in people:
        seen = is_known(px[:BODY]) & (conf[:BODY] > 0)
        uv = undistort_points(camera, px[:BODY])
        result.append((uv, np.where(seen, conf[:BODY], 0.0)))
    return result


def _groups(
    rig: CameraArray, people: Sequence[Sequence[tuple[Float, Float]]]
) -> list[_Group]:
    """The people of one frame, each with its number in every camera that shows it."""
    # Every two detections of two cameras may be the same person.
    by_rows: dict[tuple[int, ...], _Group] = {}
    for a, b in combinations(range(len(people)), 2):
        for i in range(len(people[a])):
            for j in range(len(people[b])):
                group = _group(rig, people, {a: i, b: j})
                if group is not None:
                    by_rows[group.chosen] = group

    # Groups with most confidence first; a detection belongs to one person.
    groups: list[_Group] = []
    for group in sorted(by_rows.values(), key=lambda one: -one.confidence):
        taken = False
        for other in groups:
            for mine, theirs in zip(group.chosen, other.chosen, strict=True):
                taken = taken or mine == theirs >= 0
        if not taken:
            groups.append(group)
    return groups


def _group(
    rig: CameraArray,
    people: Sequence[Sequence[tuple[Float, Float]]],
    pair: Mapping[int, int],
) -> _Group | None:
    """The person that two detections show, with those of other cameras that fit; or None."""
    # The joints by the two cameras.
    uv = np.full((len(people), BODY, 2), np.nan)
    weight = np.zeros((len(people), BODY))
    for camera, person in pair.items():
        uv[camera], weight[camera] = people[camera][person]
    both = (weight > 0).sum(0) == len(pair)
    if both.sum() < MIN_COMMON_JOINTS:
        return None
    scaled, pixels = rig.normalise(uv)
    p = plain(scaled, pixels, weight)

    # In each camera the detection that is nearest.
    chosen = []
    confidence = 0.0
    for c, candidates in enumerate(people):
        best = -1
        smallest = SAME_PERSON
        for k, (seen, conf) in enumerate(candidates):
            if c in pair and pair[c] != k:
                continue
            error = _error(rig, c, p, seen, conf)
            if error < smallest:
                best = k
                smallest = error
        if c in pair and best < 0:
            return None
        chosen.append(best)
        if best >= 0:
            share = 1 - smallest / SAME_PERSON
            confidence += share * float(candidates[best][1].sum())

    # Its place and size.
    there = p[is_known(p)]
    size = float(np.linalg.norm(np.ptp(there, axis=0)))
    return _Group(tuple(chosen), p, size, confidence)


def _error(
    rig: CameraArray, camera: int, p: Float, uv: Float, conf: Float
) -> float:
    """The median error of a detection in thousandths of the focal length; infinite if unknown."""
    one = rig[[camera]]
    scaled, pixels = one.normalise(uv[None])
    smallest = np.inf

    # Detectors may have exchanged left and right, which is corrected later.
    for joints in (p, p[list(MEDIAPIPE33.mirror)]):
        errors = scaled.errors(joints, pixels)[0]
        errors = errors[(conf > 0) & np.isfinite(errors)]
        if len(errors) >= MIN_COMMON_JOINTS:
            smallest = min(smallest, float(np.median(errors)))
    return smallest


def _way(steps: Sequence[Sequence[_Group]]) -> list[_Group | None]:
    """One group of each frame, None where there is none: most confidence, shortest steps."""
    # A step that is that much too long costs as much as all joints of all cameras.
    free = _free_step(steps)

    # The best way that ends in each group of the last frame that has some.
    scores: list[float] = []
    before: Sequence[_Group] = ()
    links: list[list[int]] = []
    for groups in steps:
        link = [-1] * len(groups)
        totals = [group.confidence for group in groups]
        for k, group in enumerate(groups):
            ways = []
            for last, score in zip(before, scores, strict=True):
                excess = max(0.0, _step(last, group) / free - 1)
                ways.append(score - excess * BODY * len(group.chosen))
            if ways:
                link[k] = int(np.argmax(ways))
                totals[k] += max(ways)
        links.append(link)
        if groups:
            scores = totals
            before = groups

    # Back from the best end.
    way: list[_Group | None] = [None] * len(steps)
    at = int(np.argmax(scores)) if scores else -1
    for f in reversed(range(len(steps))):
        if steps[f]:
            way[f] = steps[f][at]
            at = links[f][at]
    return way


def _step(before: _Group, after: _Group) -> float:
    """The distance between two groups, in sizes of the person, by the joints of both."""
    return _move(before.p, after.p) / max(before.size, after.size)


def _free_step(steps: Sequence[Sequence[_Group]]) -> float:
    """The step that costs nothing: people step to where somebody is in the next frame."""
    nearest = []
    for before, after in pairwise(steps):
        for group in after:
            if before:
                nearest.append(min(_step(last, group) for last in before))
    usual = float(np.median(nearest)) if nearest else 0.0
    return max(SMALL_STEP, USUAL_STEPS * usual)
