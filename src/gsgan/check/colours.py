"""Whether the cameras agree in exposure and white balance: the mean colours of the person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gsgan.check.report import Finding, Flagged, Table
from gsgan.check.settings import Limits
from gsgan.check.views import View, grouped
from gsgan.data.formats.trust import Float
from gsgan.data.scene_info import SceneInfo
from gsgan.effects import EffectSettings

CHANNELS = ("red", "green", "blue")
DARK = 0.05  # darker means give no ratio


def mean_colours(views: Sequence[View]) -> dict[str, tuple[Float, Float]]:
    """``[3]`` mean RGB of the person, and its ratio to the median camera's, by camera."""
    means = {
        name: np.asarray(sum(view.colour for view in own)) / sum(view.weight for view in own)
        for name, own in grouped(views).items()
        if sum(view.weight for view in own) > 0
    }
    middle = np.maximum(np.median(list(means.values()) or [np.ones(3)], axis=0), DARK)
    return {name: (mean, mean / middle) for name, mean in means.items()}


def differing(colours: Mapping[str, tuple[Float, Float]], limits: Limits) -> list[str]:
    """Cameras whose colour differs from the median camera's by more than the limit."""
    logs = {name: np.log(np.maximum(ratio, 1e-6)) for name, (_, ratio) in colours.items()}
    return [name for name, log in logs.items() if np.exp(np.abs(log).max()) > limits.colour_ratio]


def colour_findings(
    colours: Mapping[str, tuple[Float, Float]],
    info: SceneInfo | None,
    effects: EffectSettings,
    limits: Limits,
) -> list[Finding]:
    """Names the cameras whose colours differ.

    Cameras that agree on shared surface are not named: only the side that they see differs.
    ``info`` of the training split has that difference; None: unknown.
    """
    surface = None if info is None else info.surface
    agree = surface is not None and surface.difference < effects.colour_difference
    same = info.train_cameras if info is not None and agree else ()
    named = [name for name in differing(colours, limits) if name not in same]
    if not named or len(colours) < 2:
        return []
    ratios = {name: zip(CHANNELS, colours[name][1], strict=True) for name in named}
    text = "; ".join(
        f"{name} {', '.join(f'{channel} {value:.2f}' for channel, value in pairs)}"
        for name, pairs in ratios.items()
    )
    why = "seeing another side of the person does this as well"
    if surface is not None and not agree:
        why = f"on shared surface training cameras differ by {surface.difference:.3f}"
    text = (
        "cameras differ in exposure or white balance (times the median camera's mean colour of "
        f"the person): {text}; {why}. The table of effects shows whether training corrects it; "
        "effects.colour_correction=on always does"
    )
    return [Finding("warning", "colour", text)]


def colour_table(colours: Mapping[str, tuple[Float, Float]], limits: Limits) -> Table:
    """One row per camera."""
    named, rows = differing(colours, limits), []
    for name, pair in colours.items():
        mean, ratio = (" ".join(f"{v:.2f}" for v in values) for values in pair)
        rows.append((name, mean, Flagged(ratio) if name in named else ratio))
    return Table(("camera", "mean RGB of the person", "to the median camera"), tuple(rows))
