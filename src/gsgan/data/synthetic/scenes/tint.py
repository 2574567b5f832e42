"""Cameras that do not agree about colours.

Convention: on sRGB in [0, 1], as a camera's own processing acts; ``c' = A c + b``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STREAM = 77
CROSSTALK = 0.25  # of the tint: how much of a channel may leak into another
OFFSET = 0.25  # of the tint: how much may be added to a channel


@dataclass(frozen=True)
class Tint:
    """One camera's colours: ``A [3, 3]``, ``b [3]``."""

    A: Array
    b: Array

    def __call__(self, image: Array, alpha: Array) -> Array:
        """A premultiplied picture ``[H, W, 3]`` with alpha ``[H, W]``, tinted; black stays black
        where the person is not."""
        share = alpha[..., None]
        return np.clip(image @ self.A.T + share * self.b, 0, share)


def make_tints(strength: float, cameras: int, seed: int) -> list[Tint]:
    """Tints of the training cameras; their mean is the identity, so a neutral camera exists.

    One camera alone therefore keeps its colours.

    Args:
        strength: the largest change of a channel's gain.
        cameras: how many.
        seed: draws them.
    """
    rng = np.random.default_rng([STREAM, seed])
    gain, leak, offset = (rng.uniform(-1, 1, (cameras, n)) for n in (3, 9, 3))
    leak = leak.reshape(-1, 3, 3) * (1 - np.eye(3))
    # what leaks in is taken from the channel itself: grey stays grey but for the gains
    leak -= leak.sum(axis=2, keepdims=True) * np.eye(3)
    change = _centred(gain)[:, :, None] * np.eye(3) + CROSSTALK * _centred(leak)
    shift = OFFSET * _centred(offset)
    return [
        Tint(np.eye(3) + strength * a, strength * b) for a, b in zip(change, shift, strict=True)
    ]


def _centred(x: Array) -> Array:
    """With mean 0 over the cameras, scaled back into [-1, 1] where that left it."""
    x = x - x.mean(axis=0)
    return x / max(1.0, float(np.abs(x).max(initial=0)))
