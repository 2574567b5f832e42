"""Hands: which detection is whose, in every camera."""

import numpy as np
from numpy.typing import NDArray

from gsgan.data.joints import HAND_PAIRS
from gsgan.prepare.camera_array import Bool, CameraArray, Float
from gsgan.prepare.triangulate import FLIP_GAIN, apply_flips, cheapest_flips, points_and_cost
from gsgan.skeleton.hands import HAND

# Errors and distances are in thousandths of the focal length.
WRIST = 40.0  # distance from the pose's wrist at which it counts half
MAX_ERROR = 20.0  # median error beyond which a detected hand is left out
OWN_PAIRS = tuple((j, j + HAND) for j in range(len(HAND_PAIRS)))


def match_hands(cameras: CameraArray, uv: Float, weight: Float, wrists: Float) -> Bool:
    """``[C, F]`` in which camera and frame left and right hand are swapped.

    Each view starts with the assignment whose hands are nearer to the wrists of the pose; then one
    camera at a time is changed as long as distances to the wrists and errors of triangulated hands
    become smaller together. Of an assignment and its opposite in all cameras, the one with the
    smaller distances to the wrists is taken.

    Args:
        cameras: ``C`` cameras.
        uv, weight: ``[C, F, 42, 2]`` undistorted pixels, the left hand's first, NaN = not seen, and
            their confidence.
        wrists: ``[C, F, 2, 2]`` where the pose's wrists are in each view; NaN = unknown.
    """
    roots, certain = (v.reshape(*v.shape[:2], 2, HAND, -1)[:, :, :, 0] for v in (uv, weight))
    off = np.linalg.norm(roots[:, :, :, None] - wrists[:, :, None], axis=-1)  # [C, F, hand, wrist]
    # A hand is left out where one wrist is unknown: its distances cannot be compared.
    known = np.isfinite(off).all(-1, keepdims=True)
    loss = np.where(known, HAND * certain * np.log1p((off / WRIST) ** 2), 0.0)
    kept, swapped = loss[..., 0, 0] + loss[..., 1, 1], loss[..., 0, 1] + loss[..., 1, 0]

    def cost_of(flips: Bool, at: NDArray[np.int64]) -> Float:
        sided, seen = (apply_flips(v[:, at], flips[..., None], [OWN_PAIRS]) for v in (uv, weight))
        far = np.where(flips, swapped[:, at], kept[:, at]).sum(0)
        return np.asarray(points_and_cost(cameras, sided, seen)[1] + far)

    flips = cheapest_flips(cost_of, swapped < kept, FLIP_GAIN * weight.sum(-1))
    everywhere = np.arange(flips.shape[1])
    return flips ^ (cost_of(~flips, everywhere) < cost_of(flips, everywhere))


def misfits(error: Float) -> Bool:
    """``[C, F, 2]`` hands whose median of ``error [C, F, 42]`` is above `MAX_ERROR`.

    They are another person's, something else, or the same hand detected twice.
    """
    by_hand = error.reshape(*error.shape[:2], 2, HAND)
    middle = np.full(by_hand.shape[:3], np.nan)
    seen = np.isfinite(by_hand).any(-1)
    middle[seen] = np.nanmedian(by_hand[seen], axis=-1)
    return middle > MAX_ERROR
