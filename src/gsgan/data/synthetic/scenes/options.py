"""What a synthetic scene has that the default one lacks."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields
from typing import Any

from gsgan.data.cameras import DISTORTION_LENGTHS
from gsgan.utils.errors import ConfigError

MOST_TINT = 0.3
SCALES = (0.25, 4.0)


@dataclass(frozen=True)
class SceneOptions:
    """How the default person is photographed; None leaves each out.

    Args:
        lens: coefficients of every camera's lens, OpenCV order k1 k2 p1 p2 k3 ….
        tint: how far the colours of one training camera differ from another's: the largest change
            of a channel's gain.
        gloss: peak of the highlight on the glossy surfaces, as a share of the sun's strength.
        test_scale: focal lengths, relative to the training cameras', of further held-out cameras:
            each test camera gets a twin for each.

    Raises:
        ConfigError: naming the option that makes no sense.
    """

    lens: tuple[float, ...] | None = None
    tint: float | None = None
    gloss: float | None = None
    test_scale: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if self.lens is not None:
            count = " or ".join(map(str, DISTORTION_LENGTHS))
            lens = _numbers("lens", self.lens, f"{count} lens coefficients (k1 k2 p1 p2 k3 …)")
            if len(lens) not in DISTORTION_LENGTHS:
                raise ConfigError(
                    f"synthetic data: lens must list {count} lens coefficients, got {len(lens)}"
                )
            object.__setattr__(self, "lens", lens if any(lens) else None)
        for name, most in (("tint", MOST_TINT), ("gloss", 1.0)):
            value = getattr(self, name)
            if value is not None:
                (value,) = _numbers(name, [value], "a number")
                if not 0 <= value <= most:
                    raise ConfigError(
                        f"synthetic data: {name} must lie in [0, {most:g}], got {value:g}"
                    )
                object.__setattr__(self, name, value or None)
        if self.test_scale is not None:
            scales = _numbers("test_scale", self.test_scale, "relative focal lengths")
            low, high = SCALES
            for scale in scales:
                if not low <= scale <= high or scale == 1:
                    raise ConfigError(
                        f"synthetic data: test_scale must list numbers in [{low:g}, {high:g}], "
                        f"1 left out, got {scale:g}"
                    )
            if len({f"{scale:g}" for scale in scales}) < len(scales):
                raise ConfigError("synthetic data: test_scale lists a number twice")
            object.__setattr__(self, "test_scale", scales or None)

    @property
    def wanted(self) -> dict[str, Any]:
        """The options that are set, by name; empty for the default scene."""
        return {name: value for name, value in asdict(self).items() if value is not None}

    @classmethod
    def take_from(cls, parameters: dict[str, Any]) -> SceneOptions:
        """The options among keyword arguments, which lose them."""
        return cls(**{f.name: parameters.pop(f.name, None) for f in fields(cls)})


def _numbers(name: str, raw: Any, expected: str) -> tuple[float, ...]:
    listed = not isinstance(raw, str) and hasattr(raw, "__iter__")
    values = list(raw) if listed else [raw]
    good = [isinstance(v, (int, float)) and not isinstance(v, bool) for v in values]
    if not listed or not all(good) or not all(math.isfinite(v) for v in values):
        raise ConfigError(f"synthetic data: {name} must be {expected}, all finite, got {raw!r}")
    return tuple(float(v) for v in values)
