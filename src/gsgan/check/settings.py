"""The amount of data that is checked, and the thresholds; conf/check.yaml explains every field.

Thresholds that a reader applies as well are those of `gsgan.data.formats.consistency.Consistency`.
"""

from dataclasses import dataclass

from gsgan.utils.checks import above


@dataclass(frozen=True)
class Sampling:
    """The amount of a dataset that is checked, which decides the cost.

    Raises:
        ConfigError: when a value is not a number above 0.
    """

    images: int = 200
    size: int = 384
    shown: int = 6
    workers: int = 2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            above(f"sampling.{name}", value)


@dataclass(frozen=True)
class Limits:
    """Thresholds above, or below, which something is reported.

    Raises:
        ConfigError: when a value is not a number above 0.
    """

    inside_error: float = 0.7
    fullness: float = 2.0
    better_fit: float = 0.05
    outside: float = 0.004
    frame_outside: float = 0.3
    area_jump: float = 0.35
    joint_jump: float = 0.2
    limb_share: float = 0.3
    seen_share: float = 0.7
    reprojection: float = 0.05
    doubtful: float = 0.5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            above(f"limits.{name}", value)
