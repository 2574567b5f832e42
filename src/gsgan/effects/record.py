"""The decisions: the value of every effect and its reason, also as plain values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from rich.table import Table

from gsgan.utils.errors import ConfigError

OFF = "off"
HEADERS = ("effect", "", "why")


@dataclass(frozen=True)
class Effect:
    """One effect.

    Args:
        value: ``off``, ``on``, a mode, or a degree.
        why: the reason, a clause.
        forced: requested by the user, not decided from the data.
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
        distortion: ``undistort`` images when reading, or ``project``: images stay distorted and
            Gaussians follow the lens.
        antialias: opacities compensate for the rasteriser's low-pass filter.
        colour_correction: an affine colour map per training camera.
        body_points: G lies on the surface of the posed body, not on the skeleton's shapes.
        random_background: Step I compares images over a random colour.
        registration: before Ψ learns, optical flow locates the surface in the training images.
        light: colours are multiplied by a light that all points share.
        cameras: training cameras in the order of the colour corrections.
    """

    # The order of the fields is that of the printed table.
    view_dependence: Effect = Effect(0, _DEFAULT.why)
    distortion: Effect = _DEFAULT
    antialias: Effect = _DEFAULT
    colour_correction: Effect = _DEFAULT
    body_points: Effect = _DEFAULT
    random_background: Effect = _DEFAULT
    registration: Effect = _DEFAULT
    light: Effect = _DEFAULT
    cameras: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[tuple[str, Effect]]:
        for name in EFFECT_NAMES:
            yield name, getattr(self, name)

    @property
    def degree(self) -> int:
        """Degree of the spherical harmonics."""
        return int(self.view_dependence.value)

    def rows(self) -> list[tuple[str, str, str]]:
        """One row per effect: name, value, why."""
        # A degree of 0 is printed as off.
        rows = []
        for name, effect in self:
            value = str(effect.value) if effect.on else OFF
            rows.append((name, value, effect.why))
        return rows

    def table(self) -> Table:
        """The rows for a terminal."""
        # Effects that are off are dimmed.
        table = Table(title="effects", title_justify="left")
        for header in HEADERS:
            table.add_column(header, overflow="fold")
        for row in self.rows():
            table.add_row(*row, style="dim" if row[1] == OFF else None)
        return table

    def plain(self) -> dict[str, Any]:
        """Plain values, as a checkpoint holds them."""
        plain: dict[str, Any] = {name: asdict(effect) for name, effect in self}
        plain["cameras"] = list(self.cameras)
        return plain

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> Effects:
        """The inverse of `plain`."""
        # Checkpoints from before an effect existed lack it.
        effects = {
            name: Effect(**values[name])
            for name in EFFECT_NAMES
            if name in values
        }
        return cls(**effects, cameras=tuple(values["cameras"]))

    def check_same(self, stored: Mapping[str, Any]) -> None:
        """Refuses to resume a run that began with other effects, stored as `plain` gives them.

        Raises:
            ConfigError: naming the effect and what to do.
        """
        # Reasons may differ: the measured values can change with the machine.
        before = Effects.from_plain(stored)
        for name, effect in self:
            was: Effect = getattr(before, name)
            if was.value != effect.value:
                raise ConfigError(
                    f"effects.{name}: the run began with {was.value} ({was.why}), but now it is "
                    f"{effect.value} ({effect.why}); set effects.{name}={was.value}, or "
                    "resume=false to start over"
                )


# The fields that are effects.
EFFECT_NAMES = tuple(
    field.name for field in fields(Effects) if field.name != "cameras"
)
