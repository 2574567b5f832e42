"""Joints that no body could have are taken out: too far away, bones of the wrong length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsgan.data.joints import ALL, BODY, HAND, PALM
from gsgan.prepare.rig import Bool, Float, known
from gsgan.utils.errors import ConfigError

# Bones that keep their length, by the end that is doubted when one does not.
BODY_BONES = (
    *((11, 13), (13, 15), (12, 14), (14, 16)),
    *((23, 25), (25, 27), (24, 26), (26, 28)),
)
HAND_BONES = tuple((start, start + knuckle) for start in (BODY, BODY + HAND) for knuckle in PALM)


@dataclass(frozen=True)
class Cleansing:
    """What counts as impossible.

    Args:
        max_reach: metres from the median joint of the frame.
        bone: share by which a bone may differ from its median length, 0.3 = 30 %.
        hand_bone: the same for the hand's palm bones, which are short and less certain.

    Raises:
        ConfigError: when a value is not positive.
    """

    max_reach: float = 1.5
    bone: float = 0.3
    hand_bone: float = 0.3

    def __post_init__(self) -> None:
        for name in ("max_reach", "bone", "hand_bone"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"cleansing.{name} must be above 0, got {getattr(self, name)!r}")


def cleanse(p: Float, settings: Cleansing) -> tuple[Float, dict[str, int]]:
    """Points with the impossible ones NaN, and how many were taken out for which reason.

    Convention: of a bone with the wrong length the outer end goes; of a hand with most palm bones
    wrong, the whole hand. Medians are over all frames, so a person of any size fits.

    Args:
        p: ``[F, J, 3]`` metres, NaN = missing; J is 33 or 75.
        settings: thresholds.
    """
    p = p.copy()
    far = _far(p, settings.max_reach)
    p[far] = np.nan
    wrong = np.zeros(far.shape, bool)
    for joint, bad in _wrong_bones(p, BODY_BONES, settings.bone).items():
        wrong[:, joint] |= bad
    if p.shape[1] == ALL:
        bones = _wrong_bones(p, HAND_BONES, settings.hand_bone)
        for start in (BODY, BODY + HAND):
            palm = np.stack([bones[start + knuckle] for knuckle in PALM])
            wrong[:, start : start + HAND] |= (palm.sum(0) * 2 > len(PALM))[:, None]
    wrong &= known(p)
    p[wrong] = np.nan
    return p, {"too far away": int(far.sum()), "bone length": int(wrong.sum())}


def _far(p: Float, reach: float) -> Bool:
    seen = known(p)
    centre = np.full((len(p), 1, 3), np.nan)
    rows = seen.any(1)
    centre[rows, 0] = np.nanmedian(p[rows], axis=1)
    return seen & (np.linalg.norm(p - centre, axis=-1) > reach)


def bone_lengths(p: Float, bones: tuple[tuple[int, int], ...]) -> Float:
    """``[F, B]`` metres, NaN where an end is missing."""
    ends = np.array(bones)
    return np.asarray(np.linalg.norm(p[:, ends[:, 1]] - p[:, ends[:, 0]], axis=-1))


def _wrong_bones(p: Float, bones: tuple[tuple[int, int], ...], share: float) -> dict[int, Bool]:
    """Outer joint of each bone, and in which frames ``[F]`` its length is off."""
    lengths = bone_lengths(p, bones)
    seen = np.isfinite(lengths)
    usual = [
        np.median(one[ok]) if ok.any() else 1.0 for one, ok in zip(lengths.T, seen.T, strict=True)
    ]
    off = np.where(seen, np.abs(lengths / np.maximum(usual, 1e-9) - 1), 0.0) > share
    return {outer: off[:, i] for i, (_, outer) in enumerate(bones)}
