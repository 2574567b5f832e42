"""What the user asks of each effect, and from where on `auto` calls for it."""

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


@dataclass(frozen=True)
class EffectSettings:
    """One word an effect, and the thresholds of ``auto``; see conf/effects/auto.yaml for reasons.

    Convention: ``auto`` lets the scene decide, ``off`` builds and computes nothing, every other
    word forces the effect. YAML reads a bare on or off as true or false; both are understood.

    Args:
        view_dependence: ``auto``, ``off``, ``on`` (the degree that the cameras can tell), 0 to 3.
        distortion: ``auto``, ``off`` (pictures are taken as a pinhole's), ``undistort`` (or ``on``:
            pictures are undistorted on reading), or ``project`` (pictures stay as taken: Gaussians
            and joints follow the lens).
        antialias, colour_correction, body_points, random_background: ``auto``, ``on``, ``off``.
        only: names of effects: these are on, all others off, whatever else is said, except that
            lenses are followed as ``distortion`` says; None: no list.
        impossible: what becomes of a forced effect that this scene cannot have: ``error``, ``off``.
        view_residual: see ``auto``; likewise the others.
        view_spread: degrees.
        degree_cameras: training cameras from which on degree 1, 2, 3 is taken.
        colour_difference: of colours in [0, 1].
        colour_share: of the residual.
        colour_errors: standard errors.
        scale_ratio: of pixels a metre.
        dark: brightness in [0, 1].
        body_inside: share in [0, 1].
        measure: rounds in which a run times each effect that is on before it begins; 0: none.

    Raises:
        ConfigError: on a value that is not one of these, naming it.
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
    measure: int = 5

    def __post_init__(self) -> None:
        for name in CHOICES:
            object.__setattr__(self, name, _word(name, getattr(self, name)))
        if self.impossible is False:  # YAML's off
            object.__setattr__(self, "impossible", "off")
        if self.impossible not in ("error", "off"):
            raise ConfigError(f"effects.impossible must be error or off, got {self.impossible!r}")
        for name in (
            *("view_residual", "view_spread", "colour_difference", "colour_share"),
            *("colour_errors", "dark", "body_inside"),
        ):
            _at_least(name, getattr(self, name), 0)
        _at_least("scale_ratio", self.scale_ratio, 1)
        _at_least("measure", self.measure, 0)
        counts = tuple(self.degree_cameras)
        if len(counts) != 3 or list(counts) != sorted(counts):
            raise ConfigError(
                f"effects.degree_cameras must be three rising numbers, got {list(counts)}"
            )
        unknown = sorted(set(self.only or ()) - set(CHOICES))
        if unknown or isinstance(self.only, str):
            raise ConfigError(
                f"effects.only must list some of {', '.join(CHOICES)}; got "
                f"{', '.join(unknown) if not isinstance(self.only, str) else self.only}"
            )

    def wish(self, name: str) -> str | int:
        """What is asked of an effect, the list ``only`` taken into account."""
        said: str | int = getattr(self, name)
        if self.only is None:
            return said
        if name not in self.only:  # a lens is the camera's, not a choice
            return said if name == "distortion" else "off"
        return "on" if said in (AUTO, "off", 0) else said


def _word(name: str, value: str | int | bool) -> str | int:
    if value is True or value is False:
        value = "on" if value else "off"
    if value not in CHOICES[name]:
        choices = ", ".join(map(str, CHOICES[name]))
        raise ConfigError(f"effects.{name} must be one of {choices}; got {value!r}")
    return value


def _at_least(name: str, value: object, least: float) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not value >= least:
        raise ConfigError(f"effects.{name} must be a number of at least {least}, got {value!r}")
