"""Trajectories: joints that no body can have are removed, the rest is smoothed in time."""

import numpy as np

from gsgan.data.joints import ALL, BODY, FACE, HANDS, PALM, WRISTS, known
from gsgan.data.skeletons import bone_lengths
from gsgan.skeleton.hands import FINGER_BONES, HAND
from gsgan.utils.arrays import Bool, Float, nanmedian

Bones = tuple[tuple[int, int], ...]
# Bones of constant length, as (inner, outer) joint: the outer one is removed when it differs.
BODY_BONES = (
    *((11, 13), (13, 15), (12, 14), (14, 16)),
    *((23, 25), (25, 27), (24, 26), (26, 28)),
)
HAND_ROOTS = [BODY, BODY + HAND]
HAND_BONES = tuple((start, start + knuckle) for start in HAND_ROOTS for knuckle in PALM)
FINGERS = tuple((start + a, start + b) for start in HAND_ROOTS for a, b in FINGER_BONES)
FINGER_NOISE = 0.02  # metres by which noise alone changes the length of a finger's bone
MAX_REACH = 1.5  # metres from the median joint of the frame
# shares by which a length may differ from its median
BONE = 0.3
HAND_BONE = 0.3
FINGER_BONE = 0.5
WRIST = 0.1  # metres from the pose's wrist to the hand's, at most
FACE_RADIUS = 0.15  # metres from the middle of the face, at most
DEGREE = 2  # of the polynomial that smooths
REACH = 3  # standard deviations at which the smoothing kernel ends


def cleanse(p: Float) -> tuple[Float, dict[str, int]]:
    """Points ``p [F, J, 3]`` with the impossible ones set to NaN; how many, by reason.

    Convention: of a bone with the wrong length the outer end is removed; of a hand with most palm
    bones wrong, or far from the pose's wrist, the whole hand. Medians are over all frames, so a
    person of any size fits. J is 33, or 105 with hands and face; metres.
    """
    p, seen = p.copy(), known(p)
    far = seen & (np.linalg.norm(p - nanmedian(p, 1)[:, None], axis=-1) > MAX_REACH)
    if p.shape[1] == ALL:
        gap = np.linalg.norm(p[:, HAND_ROOTS] - p[:, WRISTS], axis=-1)
        far[:, HANDS] |= (gap > WRIST).repeat(HAND, axis=1)
        face = p[:, FACE]
        far[:, FACE] |= (
            np.linalg.norm(face - nanmedian(face, 1)[:, None], axis=-1) > FACE_RADIUS
        )
    far &= seen
    p[far] = np.nan
    wrong = np.zeros(far.shape, bool)
    for (_, joint), bad in zip(BODY_BONES, _off(p, BODY_BONES, BONE).T, strict=True):
        wrong[:, joint] |= bad
    if p.shape[1] == ALL:
        palms = _off(p, HAND_BONES, HAND_BONE).reshape(len(p), 2, len(PALM))
        most = palms.sum(-1) * 2 > len(PALM)
        wrong[:, HANDS] |= most.repeat(HAND, axis=1)
        fingers = _off(p, FINGERS, FINGER_BONE, FINGER_NOISE).T
        for (_, joint), bad in zip(FINGERS, fingers, strict=True):
            wrong[:, joint] |= bad
    wrong &= known(p)
    p[wrong] = np.nan
    return p, {"too far away": int(far.sum()), "bone length": int(wrong.sum())}


def _off(p: Float, bones: Bones, share: float, least: float = 0.0) -> Bool:
    """``[F, B]`` whether a bone's length differs from its median by more than the share, and by
    more than ``least`` metres."""
    lengths = bone_lengths(p, bones)
    known_lengths = (one[np.isfinite(one)] for one in lengths.T)
    usual = [max(np.median(one), 1e-9) if one.size else 1.0 for one in known_lengths]
    change = np.abs(lengths - usual)
    return np.asarray((change > share * np.array(usual)) & (change > least))


def smooth(p: Float, weight: Float, time: Float, seconds: float) -> Float:
    """Each point replaced by the value of a parabola fitted to its neighbourhood in time.

    Convention: a missing point (NaN, or weight 0) stays NaN and is ignored by its neighbours; a
    motion with constant acceleration is unchanged, gaps or not. With fewer than three known frames
    in the neighbourhood the point is left as it is. (Savitzky-Golay with weights, gaps and uneven
    time, which `scipy.signal.savgol_filter` does not have.)

    Args:
        p, weight: ``[F, J, 3]`` metres, NaN = missing, and ``[F, J]`` at least 0.
        time: ``[F]`` seconds, rising; it need not be even.
        seconds: standard deviation of the Gaussian neighbourhood.
    """
    usable = known(p) & (weight > 0)
    filled = np.where(usable[..., None], p, 0.0)
    weight = np.where(usable, weight, 0.0)
    out = np.where(usable[..., None], p, np.nan)
    if seconds == 0:
        return out
    for f, now in enumerate(time):
        near = np.abs(time - now) <= REACH * seconds
        s = (time[near] - now) / seconds
        basis = s[:, None] ** np.arange(DEGREE + 1)
        w = np.exp(-0.5 * s**2)[:, None] * weight[near]
        enough = usable[f] & (usable[near].sum(0) > DEGREE)
        normal = np.einsum("fj,fa,fb->jab", w, basis, basis)
        right = np.einsum("fj,fa,fjx->jax", w, basis, filled[near])
        normal[~enough] = np.eye(DEGREE + 1)
        fitted = np.linalg.solve(normal, right)[:, 0]
        out[f] = np.where(enough[:, None], fitted, out[f])
    return out
