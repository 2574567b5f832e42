"""The table of effects that a run and a check print."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rich.table import Table

from gsgan.effects.record import Effects

HEADERS = ("effect", "", "why", "parameters", "ms")
NAMED = {
    "view_dependence": "view-dependent colour",
    "distortion": "lens distortion",
    "antialias": "anti-aliasing",
    "colour_correction": "colour correction",
    "body_points": "points on the body",
    "random_background": "random background",
}
UNKNOWN = "–"


@dataclass(frozen=True)
class Cost:
    """The cost of an effect that is on.

    Args:
        parameters: added to the model.
        ms: added per image; None where it was not measured.
    """

    parameters: int = 0
    ms: float | None = None


def rows(effects: Effects, costs: Mapping[str, Cost] | None = None) -> list[tuple[str, ...]]:
    """One row per effect: name, value, why, parameters, milliseconds; no cost for effects off."""
    found: list[tuple[str, ...]] = []
    for name, effect in effects:
        value = str(effect.value) if effect.on else "off"
        if name == "view_dependence" and effect.on:
            value = f"degree {effect.value}"
        cost = (costs or {}).get(name)
        added = ("", "")
        if effect.on:
            added = (
                UNKNOWN if cost is None else f"{cost.parameters:,}",
                UNKNOWN if cost is None or cost.ms is None else f"{cost.ms:.2f}",
            )
        found.append((NAMED[name], value, effect.why, *added))
    return found


def effects_table(effects: Effects, costs: Mapping[str, Cost] | None = None) -> Table:
    """The rows for a terminal; without costs their columns are left out."""
    shown = len(HEADERS) if costs is not None else 3
    table = Table(title="effects", title_justify="left")
    for header in HEADERS[:shown]:
        right = header in HEADERS[3:]
        table.add_column(header, justify="right" if right else "left", overflow="fold")
    for (_, effect), row in zip(effects, rows(effects, costs), strict=True):
        table.add_row(*row[:shown], style=None if effect.on else "dim")
    return table
