"""The skeleton through time: jumps, odd limbs, frozen joints, exchanged sides. Pure functions.

Convention: ``p [F, J, 3]`` metres, ``visible [F, J]``, frames in rising order. What cannot be
judged (too few neighbours, unseen joints) is not flagged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsgan.check.silhouette import Bool, Float
from gsgan.skeleton.template import SkeletonTemplate

STILL = 1e-6  # metres: measured joints never repeat themselves this closely


def jump_distance(p: Float, visible: Bool) -> Float:
    """``[F, J]`` metres from the middle of the joint's two neighbours in time; NaN where unseen.

    A steady motion gives 0 at any speed; the first and last frame are not judged.
    """
    distance = np.full(p.shape[:2], np.nan)
    if len(p) > 2:
        middle = (p[:-2] + p[2:]) / 2
        seen = visible[:-2] & visible[1:-1] & visible[2:]
        distance[1:-1] = np.where(seen, np.linalg.norm(p[1:-1] - middle, axis=-1), np.nan)
    return distance


def jumped(distance: Float, limit: float) -> Bool:
    """``[F, J]`` the peaks of `jump_distance` beyond the limit.

    One stray frame also moves its neighbours' middles, by half as much; only the peak is named.
    """
    known = np.nan_to_num(distance)
    before, after = np.zeros_like(known), np.zeros_like(known)
    before[1:], after[:-1] = known[:-1], known[1:]
    return (known > limit) & (known >= before) & (known >= after)


def limb_lengths(p: Float, visible: Bool, template: SkeletonTemplate) -> Float:
    """``[F, L]`` metres, NaN where an end was not seen."""
    a, b = np.array(template.limbs).T
    lengths = np.linalg.norm(p[:, a] - p[:, b], axis=-1)
    return np.where(visible[:, a] & visible[:, b], lengths, np.nan)


def odd_limbs(lengths: Float, share: float, metres: float) -> tuple[Bool, Float]:
    """Which limbs ``[F, L]`` are off their median by more than both limits; and the share off.

    Args:
        lengths: of `limb_lengths`.
        share: of the limb's median length.
        metres: so that the noise of short bones does not count.
    """
    typical = nanmedian(lengths)
    off = np.abs(lengths - typical)
    relative = off / np.maximum(typical, STILL)
    return (off > metres) & (relative > share), relative


def nanmedian(values: Float) -> Float:
    """Median over the first axis, NaN where nothing is known, without a warning."""
    known = ~np.isnan(values).all(0)
    result = np.full(values.shape[1:], np.nan)
    result[known] = np.nanmedian(values[:, known], axis=0)
    return result


def frozen(p: Float, visible: Bool, least: int) -> Bool:
    """``[F, J]`` joints that stand exactly still for at least ``least`` frames in a row.

    Gap filling and copied frames do this; measured joints never do, computed ones may.
    """
    same = np.zeros(visible.shape, bool)
    same[1:] = np.linalg.norm(p[1:] - p[:-1], axis=-1) < STILL
    same[1:] &= visible[1:] & visible[:-1]
    held = np.zeros_like(same)
    for joint in range(len(visible[0])):
        for first, last in runs(same[:, joint]):
            if last - first + 2 >= least:  # a run of n equal steps joins n + 1 frames
                held[first - 1 : last + 1, joint] = True
    return held


def measured_joints(lengths: Float, template: SkeletonTemplate, share: float) -> Bool:
    """``[J]`` joints with a bone whose length changes by more than this share of its median.

    The bones of a posed body model keep their length, measured ones do not.

    Args:
        lengths: ``[F, L]`` of `limb_lengths`.
        template: names the limbs.
        share: see above.
    """
    typical = nanmedian(lengths)
    off = np.nan_to_num(np.abs(lengths - typical) / np.maximum(typical, STILL)).max(0)
    measured = np.zeros(len(template.names), bool)
    for (a, b), changes in zip(template.limbs, off > share, strict=True):
        measured[[a, b]] |= changes
    return measured


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def body_parts(template: SkeletonTemplate) -> dict[str, tuple[tuple[int, int], ...]]:
    """(left, right) joints that would be exchanged together, by the part's name."""
    pairs = [(a, b) for a, b in enumerate(template.mirror) if "left" in template.names[a]]
    parts = {
        "face": set(template.face),
        "arms": _reach(template, template.shoulders),
        "legs": _reach(template, template.hips),
    }
    return {name: tuple(p for p in pairs if p[0] in joints) for name, joints in parts.items()}


def _reach(template: SkeletonTemplate, roots: tuple[int, int]) -> set[int]:
    """The roots and every joint that hangs on them by limbs."""
    found = set(roots)
    for _ in template.limbs:
        found |= {b for a, b in template.limbs if a in found}
    return found


def swapped(
    p: Float,
    visible: Bool,
    pairs: tuple[tuple[int, int], ...],
    ratio: float,
    metres: float,
) -> Bool:
    """``[F]`` frames in which a body part's left and right are exchanged against the others.

    Going from frame to frame the part is exchanged where exchanging brings it nearer to where it
    was: mean distance at least ``ratio`` times and ``metres`` less. Between two exchanges lies the
    wrong side, or the right one: the smaller half of the frames counts as wrong.

    Args:
        p: ``[F, J, 3]``.
        visible: ``[F, J]``.
        pairs: (left, right) joints of the part.
        ratio, metres: see above.
    """
    flipped = np.zeros(len(p), bool)
    if not pairs or len(p) < 3:
        return flipped
    left, right = np.array(pairs).T
    both = visible[:, left] & visible[:, right]
    state = np.zeros(len(p), bool)
    last: int | None = None
    for f in range(len(p)):
        if not both[f].any():
            state[f] = state[f - 1] if f else False
            continue
        if last is None:
            last = f
            continue
        shared = both[f] & both[last]
        exchange = False
        if shared.any():
            a, b = left[shared], right[shared]
            straight = _apart(p[f, a], p[last, a]) + _apart(p[f, b], p[last, b])
            across = _apart(p[f, a], p[last, b]) + _apart(p[f, b], p[last, a])
            gain = (straight - across).mean() / 2
            exchange = bool(straight.mean() > ratio * across.mean() and gain > metres)
        state[f] = state[last] ^ exchange
        state[last + 1 : f] = state[last]
        last = f
    wrong = state.mean() <= 0.5
    return state if wrong else ~state


def _apart(a: Float, b: Float) -> Float:
    return np.asarray(np.linalg.norm(a - b, axis=-1))


def facing(p: Float, visible: Bool, template: SkeletonTemplate) -> Float:
    """``[F]`` positive where nose and toes lie before the trunk, negative behind; NaN unknown.

    The trunk's front follows from its left and right; nose against ears and toes against ankles
    show the true one. All frames negative: left and right are exchanged throughout.
    """
    l_sh, r_sh, l_hip, r_hip = (p[:, j] for j in template.torso)
    trunk = visible[:, list(template.torso)].all(1)
    front = np.cross(l_sh - r_sh, l_sh + r_sh - l_hip - r_hip)
    votes = np.full((len(p), 3), np.nan)
    face = [template.nose, *template.ears]
    ahead = p[:, template.nose] - p[:, list(template.ears)].mean(1)
    votes[:, 0] = np.where(visible[:, face].all(1), np.sign((ahead * front).sum(-1)), np.nan)
    for column, (ankle, toe) in enumerate(toes(template), start=1):
        ahead = p[:, toe] - p[:, ankle]
        seen = visible[:, [ankle, toe]].all(1)
        votes[:, column] = np.where(seen, np.sign((ahead * front).sum(-1)), np.nan)
    known = trunk & ~np.isnan(votes).all(1)
    result = np.full(len(p), np.nan)
    result[known] = np.nanmean(votes[known], axis=1)
    return result


def toes(template: SkeletonTemplate) -> tuple[tuple[int, int], tuple[int, int]]:
    """(ankle, toe) joints, left and right."""
    names = template.names
    left, right = (
        (names.index(f"{side}_ankle"), names.index(f"{side}_foot_index"))
        for side in ("left", "right")
    )
    return left, right
