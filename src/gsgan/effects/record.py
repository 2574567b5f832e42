"""The decision: every effect with its value and the reason, as plain values for a checkpoint."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from gsgan.utils.errors import ConfigError

OFF = "off"


@dataclass(frozen=True)
class Effect:
    """One effect.

    Args:
        value: ``off``; else ``on``, a mode's name, or a degree above 0.
        why: the reason, half a sentence.
        forced: the user said so.
    """

    value: str | int
    why: str
    forced: bool = False

    @property
    def on(self) -> bool:
        """Whether anything is built or computed for it."""
        return self.value not in (OFF, 0)


_DEFAULT = Effect(OFF, "nothing was decided")


@dataclass(frozen=True)
class Effects:
    """All effects of one run.

    Args:
        view_dependence: degree of the spherical harmonics, 0 to 3.
        distortion: ``undistort``, or ``project``: pictures stay as taken, Gaussians follow.
        antialias: opacities make up for the rasteriser's low-pass.
        colour_correction: an affine map of colours a training camera.
        body_points: G sits on the surface of the posed body, not on the skeleton's shapes.
        random_background: Step I compares pictures over a random colour.
        cameras: training cameras in the order of the colour corrections.
    """

    view_dependence: Effect = Effect(0, _DEFAULT.why)
    distortion: Effect = _DEFAULT
    antialias: Effect = _DEFAULT
    colour_correction: Effect = _DEFAULT
    body_points: Effect = _DEFAULT
    random_background: Effect = _DEFAULT
    cameras: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[tuple[str, Effect]]:
        return ((name, getattr(self, name)) for name in NAMES)

    @property
    def degree(self) -> int:
        """Of the spherical harmonics."""
        return int(self.view_dependence.value)

    def without(self, name: str, why: str) -> Effects:
        """The same with one effect off.

        Raises:
            ConfigError: when the user forced it.
        """
        effect: Effect = getattr(self, name)
        if not effect.on:
            return self
        if effect.forced:
            raise ConfigError(f"effects.{name}={effect.value} is not possible: {why}")
        return self.switched_off(name, why)

    def switched_off(self, name: str, why: str) -> Effects:
        """The same with one effect off, whoever asked for it."""
        off = Effect(0 if name == "view_dependence" else OFF, why)
        return replace(self, **{name: off})  # type: ignore[arg-type]

    def plain(self) -> dict[str, Any]:
        """Plain values, as a checkpoint holds them."""
        return {name: asdict(effect) for name, effect in self} | {"cameras": list(self.cameras)}

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> Effects:
        """From what `plain` gave; an effect it does not know is off."""
        found = {name: Effect(**values[name]) for name in NAMES if name in values}
        return cls(**found, cameras=tuple(values.get("cameras", ())))


NAMES = tuple(field.name for field in fields(Effects) if field.name != "cameras")
