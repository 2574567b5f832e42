"""The table of effects that a run and a check print."""

from rich.table import Table

from gsgan.effects.record import Effects

HEADERS = ("effect", "", "why")
NAMED = {
    "view_dependence": "view-dependent colour",
    "distortion": "lens distortion",
    "antialias": "anti-aliasing",
    "colour_correction": "colour correction",
    "body_points": "points on the body",
    "random_background": "random background",
}


def rows(effects: Effects) -> list[tuple[str, str, str]]:
    """One row per effect: name, value, why."""
    found = []
    for name, effect in effects:
        value = str(effect.value) if effect.on else "off"
        if name == "view_dependence" and effect.on:
            value = f"degree {effect.value}"
        found.append((NAMED[name], value, effect.why))
    return found


def effects_table(effects: Effects) -> Table:
    """The rows for a terminal."""
    table = Table(title="effects", title_justify="left")
    for header in HEADERS:
        table.add_column(header, overflow="fold")
    for (_, effect), row in zip(effects, rows(effects), strict=True):
        table.add_row(*row, style=None if effect.on else "dim")
    return table
