"""Whether the cameras agree on colour: mean colours, and the measure that training goes by."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gsgan.check.report import Finding, Table
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

    Args:
        colours: of `mean_colours`.
        info: of the training split, for the difference on shared surface; None: unknown.
        effects: the difference from which training corrects colours.
        limits: how much mean colours may differ.
    """
    surface = None if info is None else info.surface
    agree = surface is not None and surface.difference < effects.colour_difference
    same = info.train_cameras if info is not None and agree else ()
    named = [name for name in differing(colours, limits) if name not in same]
    if not named or len(colours) < 2:
        return []
    text = "; ".join(
        f"{name} "
        + ", ".join(f"{n} {v:.2f}" for n, v in zip(CHANNELS, colours[name][1], strict=True))
        for name in named
    )
    why = "; seeing another side of the person does this as well"
    if surface is not None and not agree:
        why = f"; on shared surface training cameras differ by {surface.difference:.3f}"
    return [
        Finding(
            "warning", "colour",
            "cameras differ in exposure or white balance (times the median camera's mean colour "
            f"of the person): {text}{why}. The table of effects shows whether training corrects "
            "it; effects.colour_correction=on always does",
        )
    ]  # fmt: skip


def colour_table(colours: Mapping[str, tuple[Float, Float]], limits: Limits) -> Table:
    """One row per camera."""
    rows = tuple((name, *map(_triple, values)) for name, values in colours.items())
    named = differing(colours, limits)
    flagged = frozenset((i, 2) for i, row in enumerate(rows) if row[0] in named)
    return Table(("camera", "mean RGB of the person", "to the median camera"), rows, flagged)


def _triple(values: Float) -> str:
    return " ".join(f"{v:.2f}" for v in values)
