"""What fitting costs and how far it trusts the landmarks."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from gsgan.utils.errors import ConfigError

if TYPE_CHECKING:  # they load torch
    from gsgan.skeleton import Densify
    from gsgan.splat import Accuracy

PARTS = ("densify", "accuracy")  # not numbers


@dataclass(frozen=True)
class Fit:
    """Settings of the fit; what most of them give and cost is measured in docs/data.md.

    Args:
        densify: skeleton to points.
        accuracy: the rasteriser's settings.
        least_mask: a picture with a smaller share of the usual mask area is left out.
        shape_steps: steps on the shape alone, before joints move.
        sweeps: passes over all frames; each moves every frame's joints once, and the shape.
        cameras: a step looks at so many cameras at most, drawn by chance.
        noise: metres that a landmark may plausibly be off: the unit of the two priors.
        prior: weight of the joints' mean squared move.
        bones: weight of the limbs' mean squared difference from their median lengths.
        joint_rate: metres, the step of Adam.
        shape_rate: of the shape's numbers, the step of Adam.
        hold: share of the sweeps before the rates fall.

    Raises:
        ConfigError: on a value out of its range.
    """

    densify: Densify
    accuracy: Accuracy
    least_mask: float = 0.1
    shape_steps: int = 150
    sweeps: int = 20
    cameras: int = 8
    noise: float = 0.02
    prior: float = 0.02
    bones: float = 0.02
    joint_rate: float = 0.004
    shape_rate: float = 0.01
    hold: float = 0.4

    def __post_init__(self) -> None:
        for name in PARTS:
            if getattr(self, name) is None:
                raise ConfigError(f"fit.{name} cannot be null; conf/fit/standard.yaml has it")
        above = {"least_mask", "sweeps", "cameras", "noise", "joint_rate", "shape_rate"}
        for field in fields(self):
            if field.name in PARTS:
                continue
            value = getattr(self, field.name)
            whole = isinstance(field.default, int)
            kind = int if whole else (int, float)
            fits = isinstance(value, kind) and not isinstance(value, bool) and value >= 0
            if not fits or (field.name in above and value == 0):
                what = "a whole number" if whole else "a number"
                least = "above 0" if field.name in above else "of at least 0"
                raise ConfigError(f"fit.{field.name} must be {what} {least}, got {value!r}")
        if self.hold > 1:
            raise ConfigError(f"fit.hold is a share of the sweeps, at most 1; got {self.hold!r}")
