"""Colour differences between cameras.

Convention: RGB, sRGB in [0, 1], premultiplied on black.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TINT_STREAM = 77
CROSSTALK = 0.25  # leak from channel to channel, as a share of the tint
OFFSET = 0.25  # largest offset of a channel, as a share of the tint


@dataclass(frozen=True)
class Tint:
    """One camera's colours, ``A c + b`` on sRGB in [0, 1]: ``A [3, 3]``, ``b [3]``."""

    A: Array
    b: Array

    def __call__(self, image: Array, alpha: Array) -> Array:
        """Tints a premultiplied image ``[H, W, 3]`` with alpha ``[H, W]``."""
        share = alpha[..., None]
        return np.clip(image @ self.A.T + share * self.b, 0, share)


def make_tints(strength: float, cameras: int, seed: int) -> list[Tint]:
    """Random tints of the training cameras, ``strength`` the largest change of a channel's gain.

    Their mean is the identity, so a single camera has none.
    """
    rng = np.random.default_rng([TINT_STREAM, seed])
    gain, leak, offset = (rng.uniform(-1, 1, (cameras, n)) for n in (3, 9, 3))
    leak = leak.reshape(-1, 3, 3) * (1 - np.eye(3))
    # a leak is subtracted from the channel itself, so that grey stays grey but for the gains
    leak -= leak.sum(axis=2, keepdims=True) * np.eye(3)
    change = _centred(gain)[:, :, None] * np.eye(3) + CROSSTALK * _centred(leak)
    shift = OFFSET * _centred(offset)
    return [
        Tint(np.eye(3) + strength * a, strength * b) for a, b in zip(change, shift, strict=True)
    ]


def _centred(x: Array) -> Array:
    """Shifted to mean 0 over the cameras, then scaled to within [-1, 1]."""
    x = x - x.mean(axis=0)
    return x / max(1.0, float(np.abs(x).max(initial=0)))
