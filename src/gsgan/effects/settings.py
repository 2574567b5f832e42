"""The values requested for each effect, and the thresholds of ``auto``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
LEAST = {  # smallest value of each number
    **dict.fromkeys(("view_residual", "colour_difference", "colour_share", "colour_errors"), 0),
    **dict.fromkeys(("dark", "body_inside", "measure"), 0),
    "scale_ratio": 1,
}


@dataclass(frozen=True)
class EffectSettings:
    """A requested value per effect, and thresholds (reasons: conf/effects/auto.yaml).

    Convention: ``auto`` decides from the scene, ``off`` builds and computes nothing, any other
    value forces the effect. YAML's bare on and off arrive as true and false and are accepted.

    Args:
        view_dependence: ``auto``, ``off``, ``on`` (the degree that the cameras resolve), 0 to 3.
        distortion: ``auto``, ``off`` (images are treated as a pinhole's), ``undistort`` or ``on``
            (images are undistorted when read), ``project`` (images stay distorted: Gaussians and
            joints follow the lens).
        antialias, colour_correction, body_points, random_background: ``auto``, ``on``, ``off``.
        only: names of effects: these are on and all others off, except that lenses follow
            ``distortion``; None: no list.
        impossible: what a forced effect that is not possible does: ``error``, or ``off``.
        view_residual: colour difference in [0, 1].
        view_spread: degrees.
        degree_cameras: training cameras needed for degree 1, 2, 3.
        colour_difference: of colours in [0, 1].
        colour_share: share of the residual.
        colour_errors: standard errors.
        scale_ratio: ratio of pixels per metre.
        dark: brightness in [0, 1].
        body_inside: share in [0, 1].
        measure: rounds in which a run times each effect before training; 0: none.

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
    view_spread: float = 20.0
    degree_cameras: Sequence[int] = (2, 4, 8)
    colour_difference: float = 0.03
    colour_share: float = 0.5
    colour_errors: float = 3.0
    scale_ratio: float = 1.3
    dark: float = 0.25
    body_inside: float = 0.95
    measure: int = 0

    def __post_init__(self) -> None:
        for name in CHOICES:
            object.__setattr__(self, name, _choice(name, getattr(self, name)))
        if self.impossible is False:  # YAML's off
            object.__setattr__(self, "impossible", "off")
        if self.impossible not in ("error", "off"):
            raise ConfigError(f"effects.impossible must be error or off, got {self.impossible!r}")
        for name, least in LEAST.items():
            value = getattr(self, name)
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not number or not value >= least:
                raise ConfigError(
                    f"effects.{name} must be a number of at least {least}, got {value!r}"
                )
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
        if name not in self.only:  # a lens belongs to the camera: it is not a choice
            return value if name == "distortion" else "off"
        return "on" if value in (AUTO, "off", 0) else value


def _choice(name: str, value: str | int | bool) -> str | int:
    if isinstance(value, bool):
        value = "on" if value else "off"
    if value not in CHOICES[name]:
        choices = ", ".join(map(str, CHOICES[name]))
        raise ConfigError(f"effects.{name} must be one of {choices}; got {value!r}")
    return value
