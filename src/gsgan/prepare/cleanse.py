"""Trajectories: joints that no body can have are removed, the rest is smoothed in time."""

import numpy as np

from gsgan.data.skeletons import bone_lengths
from gsgan.skeleton.hands import FINGER_BONES, HAND
from gsgan.skeleton.joints import (
    ALL,
    BODY,
    FACE,
    HANDS,
    PALM_JOINTS,
    WRIST_JOINTS,
    is_known,
)
from gsgan.utils.arrays import Bool, Float, nanmedian

Bones = tuple[tuple[int, int], ...]
# Bones of constant length, as (inner, outer) joint: the outer one is removed if it differs.
CHECKED_BONES = (
    (11, 13),
    (13, 15),
    (12, 14),
    (14, 16),
    (23, 25),
    (25, 27),
    (24, 26),
    (26, 28),
)
HAND_ROOTS = [BODY, BODY + HAND]
HAND_BONES = tuple(
    (start, start + knuckle) for start in HAND_ROOTS for knuckle in PALM_JOINTS
)
FINGERS_OF_BOTH = tuple(
    (start + a, start + b) for start in HAND_ROOTS for a, b in FINGER_BONES
)
# metres by which noise alone changes the length of a finger's bone
FINGER_NOISE = 0.02
MAX_REACH = 1.5  # metres from the median joint of the frame
# Maximum difference of a length from its median, as a share of it.
BONE = 0.3
HAND_BONE = 0.3
FINGER_BONE = 0.5
# maximum distance from the pose's wrist to the hand's, metres
MAX_WRIST_GAP = 0.1
FACE_RADIUS = 0.15  # maximum distance from the middle of the face, metres
DEGREE = 2  # of the polynomial that smooths
KERNEL_END = 3  # standard deviations at which the smoothing kernel ends


def cleanse(p: Float) -> tuple[Float, dict[str, int]]:
    """Points ``p [F, J, 3]`` with the impossible ones set to NaN, and their number by reason.

    If a bone has the wrong length, its outer end is removed. The whole hand is removed if most palm
    bones are wrong, or if it is far from the pose's wrist. Medians are over all frames, so a person
    of any size fits. J is 33, or 105 with hands and face; metres.
    """
    p = p.copy()
    seen = is_known(p)
    has_hands = p.shape[1] == ALL

    # Joints too far from the body, the wrist or the middle of the face.
    far = _distance_from_median(p) > MAX_REACH
    if has_hands:
        gap = np.linalg.norm(p[:, HAND_ROOTS] - p[:, WRIST_JOINTS], axis=-1)
        far[:, HANDS] |= (gap > MAX_WRIST_GAP).repeat(HAND, axis=1)
        far[:, FACE] |= _distance_from_median(p[:, FACE]) > FACE_RADIUS
    far &= seen
    p[far] = np.nan

    # Joints at the end of bones of the wrong length.
    wrong = np.zeros_like(far)
    _mark_ends(wrong, CHECKED_BONES, _misfit(p, CHECKED_BONES, BONE))
    if has_hands:
        palms = _misfit(p, HAND_BONES, HAND_BONE)
        palms = palms.reshape(len(p), 2, len(PALM_JOINTS))
        majority = palms.sum(-1) * 2 > len(PALM_JOINTS)
        wrong[:, HANDS] |= majority.repeat(HAND, axis=1)
        _mark_ends(
            wrong,
            FINGERS_OF_BOTH,
            _misfit(p, FINGERS_OF_BOTH, FINGER_BONE, FINGER_NOISE),
        )
    wrong &= is_known(p)
    p[wrong] = np.nan
    return p, {"too far away": int(far.sum()), "bone length": int(wrong.sum())}


def _distance_from_median(p: Float) -> Float:
    """Distances ``[F, J]`` of points ``[F, J, 3]`` from their median point in each frame."""
    middle = nanmedian(p, 1)[:, None]
    return np.linalg.norm(p - middle, axis=-1)


def _mark_ends(mask: Bool, bones: Bones, wrong: Bool) -> None:
    """Marks the outer ends of the bones that are ``wrong [F, B]`` in ``mask [F, J]``."""
    for b, (_, joint) in enumerate(bones):
        mask[:, joint] |= wrong[:, b]


def _misfit(p: Float, bones: Bones, share: float, noise: float = 0.0) -> Bool:
    """The bones ``[F, B]`` whose length differs from its median.

    Args:
        p: ``[F, J, 3]`` metres.
        bones: B bones.
        share: of the median by which a length may differ.
        noise: metres by which it may differ too.
    """
    # The median length of each bone; 1 if it is never known.
    lengths = bone_lengths(p, bones)
    usual = np.ones(len(bones))
    for b, values in enumerate(lengths.T):
        finite = values[np.isfinite(values)]
        if len(finite):
            usual[b] = max(np.median(finite), 1e-9)

    # A length must be off by a share and by more than the noise.
    change = np.abs(lengths - usual)
    return (change > share * usual) & (change > noise)


def smooth(p: Float, weight: Float, time: Float, seconds: float) -> Float:
    """Points replaced by the value of a parabola fitted to their neighbourhood in time.

    A missing point (NaN, or weight 0) stays NaN and is ignored by its neighbours; a motion with
    constant acceleration is unchanged, gaps or not. With fewer than three known frames in the
    neighbourhood the point is left as it is. (Savitzky-Golay with weights, gaps and uneven time,
    which `scipy.signal.savgol_filter` does not have.)

    Args:
        p: ``[F, J, 3]`` metres, NaN = missing.
        weight: ``[F, J]`` minimum 0.
        time: ``[F]`` seconds, increasing; steps may be uneven.
        seconds: standard deviation of the Gaussian neighbourhood.
    """
    # Points that are not used are 0 in the sums and NaN in the result.
    usable = is_known(p) & (weight > 0)
    filled = np.where(usable[..., None], p, 0.0)
    weight = np.where(usable, weight, 0.0)
    result = np.where(usable[..., None], p, np.nan)
    if seconds == 0:
        return result

    # Normal equations of each frame's parabola, whose constant is the value at that frame.
    for f, now in enumerate(time):
        # A Gaussian neighbourhood, in units of its standard deviation.
        near = np.abs(time - now) <= KERNEL_END * seconds
        s = (time[near] - now) / seconds
        basis = s[:, None] ** np.arange(DEGREE + 1)
        w = np.exp(-0.5 * s**2)[:, None] * weight[near]

        # The equations of each joint; too few frames leave it as it is.
        H = np.einsum("fj,fa,fb->jab", w, basis, basis)
        right = np.einsum("fj,fa,fjx->jax", w, basis, filled[near])
        enough = usable[f] & (usable[near].sum(0) > DEGREE)
        H[~enough] = np.eye(DEGREE + 1)
        fitted = np.linalg.solve(H, right)[:, 0]
        result[f] = np.where(enough[:, None], fitted, result[f])
    return result
