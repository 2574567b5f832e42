"""The skeleton over time: jumps, odd limbs, frozen joints, exchanged sides. Pure functions.

Convention: ``p [F, J, 3]`` metres, ``visible [F, J]``, frames in rising order. What cannot be
measured (too few neighbours, joints not visible) is not flagged.
"""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from gsgan.data.formats.trust import Bool, Float
from gsgan.skeleton.template import SkeletonTemplate

STILL = 1e-6  # metres: measured joints never repeat this closely
SWAP_RATIO = 2.0  # exchanged sides must be this many times nearer to where they were
SWAP_METRES = 0.06  # and this much nearer: crossing feet come close


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
    changing = (np.nan_to_num(change) > share).any(0)
    for limb in np.flatnonzero(changing):
        measured[list(template.limbs[limb])] = True
    return measured


def nanmedian(values: Float) -> Float:
    """Median over the first axis, NaN where nothing is known, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmedian(values, axis=0))


def frozen(p: Float, visible: Bool, least: int) -> Bool:
    """``[F, J]`` joints that stand exactly still for at least ``least`` frames in a row.

    Gap filling and copied frames do this; measured joints never do, computed ones may.
    """
    same = np.zeros(visible.shape, bool)
    same[1:] = np.linalg.norm(p[1:] - p[:-1], axis=-1) < STILL
    same[1:] &= visible[1:] & visible[:-1]
    held = np.zeros_like(same)
    for joint in range(p.shape[1]):
        for first, last in runs(same[:, joint]):
            if last - first + 2 >= least:  # a run of n equal steps joins n + 1 frames
                held[first - 1 : last + 1, joint] = True
    return held


def runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last index of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


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
    these exchanges separate counts as wrong.

    Args:
        p: ``[F, J, 3]``.
        visible: ``[F, J]``.
        pairs: (left, right) joints of the part.
        metres: see above.
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
