"""The values requested for each effect, and the thresholds of ``auto``."""

from collections.abc import Sequence
from dataclasses import dataclass

from gsgan.utils.checks import one_of
from gsgan.utils.errors import ConfigError

AUTO = "auto"
ON_OFF = (AUTO, "on", "off")
CHOICES: dict[str, tuple[str | int, ...]] = {
    "view_dependence": (*ON_OFF, 0, 1, 2, 3),
    "distortion": (*ON_OFF, "undistort", "project"),
    "antialias": ON_OFF,
    "colour_correction": ON_OFF,
    "body_points": ON_OFF,
    "random_background": ON_OFF,
}


@dataclass(frozen=True)
class EffectSettings:
    """A requested value per effect, and the thresholds of ``auto``; see conf/effects/auto.yaml.

    Convention: ``auto`` decides from the scene, ``off`` builds and computes nothing, any other
    value forces the effect. YAML's bare on and off arrive as true and false and are accepted.

    Raises:
        ConfigError: on a value that is not allowed, naming it.
    """

    view_dependence: str | int | bool = AUTO
    distortion: str | bool = AUTO
    antialias: str | bool = AUTO
    colour_correction: str | bool = AUTO
    body_points: str | bool = AUTO
    random_background: str | bool = AUTO
    only: Sequence[str] | None = None
    impossible: str | bool = "error"
    view_residual: float = 0.09
    degree_cameras: Sequence[int] = (2, 4, 8)
    colour_difference: float = 0.03
    colour_share: float = 0.5
    scale_ratio: float = 1.3
    dark: float = 0.25
    body_inside: float = 0.95

    def __post_init__(self) -> None:
        for name in CHOICES:
            value = getattr(self, name)
            if isinstance(value, bool):
                value = "on" if value else "off"
            object.__setattr__(self, name, one_of(f"effects.{name}", value, CHOICES[name]))
        if self.impossible is False:  # YAML's off
            object.__setattr__(self, "impossible", "off")
        one_of("effects.impossible", self.impossible, ("error", "off"))
        counts = list(self.degree_cameras)
        if len(counts) != 3 or counts != sorted(counts):
            raise ConfigError(f"effects.degree_cameras must be three rising numbers, got {counts}")
        listed = [self.only] if isinstance(self.only, str) else list(self.only or ())
        if isinstance(self.only, str) or set(listed) - set(CHOICES):
            raise ConfigError(f"effects.only must list some of {', '.join(CHOICES)}; got {listed}")

    def requested(self, name: str) -> str | int:
        """The value requested for an effect, with ``only`` taken into account."""
        value: str | int = getattr(self, name)
        if self.only is None:
            return value
        if name not in self.only:  # distortion is a property of the camera, not an option
            return value if name == "distortion" else "off"
        return "on" if value in (AUTO, "off", 0) else value
