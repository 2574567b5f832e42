"""Whether the cameras agree on colour: on the whole person, and on surface that two of them see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from gsgan.check.calibration import grouped
from gsgan.check.findings import Finding, Table
from gsgan.check.hull import Carving
from gsgan.check.looking import Look
from gsgan.check.settings import Limits
from gsgan.check.silhouette import Float

CHANNELS = ("red", "green", "blue")
DARK = 0.05  # a darker pixel says little about a ratio
LEAST_POINTS = 30  # surface points that a pair of cameras must share
SURFACE = 1.5  # voxel edges: how far behind the nearest one still counts as the surface


@dataclass(frozen=True)
class Colours:
    """The colours of one camera.

    Args:
        mean: ``[3]`` RGB of the person, 0..1.
        ratio: ``[3]`` of that to the median camera's.
        gain: ``[3]`` on surface that other cameras see too, to the median camera's; None when too
            little is shared. Unlike ``ratio`` it does not change with the side that is seen.
    """

    mean: Float
    ratio: Float
    gain: Float | None

    @property
    def judged(self) -> Float:
        """``[3]`` what is held against the limit: the gain where there is one."""
        return self.ratio if self.gain is None else self.gain


def score_colours(looks: Sequence[Look], carved: Sequence[Carving]) -> dict[str, Colours]:
    """The colours of every camera whose masks are not empty."""
    means = {
        name: np.asarray(sum(look.colour for look in own)) / sum(look.weight for look in own)
        for name, own in grouped(looks).items()
        if sum(look.weight for look in own) > 0
    }
    if not means:
        return {}
    middle = np.maximum(np.median(list(means.values()), axis=0), DARK)
    gains = shared_gains(tuple(means), carved)
    return {
        name: Colours(mean, mean / middle, gains.get(name) if gains else None)
        for name, mean in means.items()
    }


def shared_gains(names: tuple[str, ...], carved: Sequence[Carving]) -> Mapping[str, Float] | None:
    """``[3]`` gain of each camera to the median one, from surface points that two cameras see.

    The hull's surface stands in for the person's. Each pair of cameras gives the median log ratio
    of its shared points; the gains are their least-squares solution. None when the pairs do not
    join all cameras.
    """
    index = {name: i for i, name in enumerate(names)}
    logs: dict[tuple[int, int], list[Float]] = {}
    for carving in carved:
        colours = [_surface_colours(carving, i) for i in range(len(carving.looks))]
        cameras = [look.camera for look in carving.looks]
        for a, b in combinations(range(len(cameras)), 2):
            if cameras[a] in index and cameras[b] in index:
                both = ~np.isnan(colours[a][:, 0] + colours[b][:, 0])
                ratios = np.log(colours[a][both] / colours[b][both])
                logs.setdefault((index[cameras[a]], index[cameras[b]]), []).append(ratios)
    rows, values, weights = [], [], []
    for (i, j), found in logs.items():
        ratios = np.concatenate(found)
        if len(ratios) >= LEAST_POINTS:
            row = np.zeros(len(names))
            row[i], row[j] = 1, -1
            rows.append(row)
            values.append(np.median(ratios, axis=0))
            weights.append(np.sqrt(len(ratios)))
    if not rows or np.linalg.matrix_rank(np.array(rows)) < len(names) - 1:
        return None
    weight = np.array(weights)[:, None]
    solved = np.linalg.lstsq(np.array(rows) * weight, np.array(values) * weight, rcond=None)[0]
    gains = np.exp(solved - np.median(solved, axis=0))
    return {name: gains[i] for name, i in index.items()}


def _surface_colours(carving: Carving, i: int) -> Float:
    """``[V, 3]`` colour of the hull's voxels in camera i, NaN where hidden, off or dark."""
    look, hull = carving.looks[i], carving.hull
    colours = np.full((len(hull), 3), np.nan)
    at = carving.pixels[i]
    shown = np.flatnonzero(hull & (at[:, 0] >= 0))
    flat = at[shown, 1] * look.mask.shape[1] + at[shown, 0]
    nearest = np.full(look.mask.size, np.inf)
    # a voxel covers more than its pixel: depths are compared on a grid as coarse as the voxels
    coarse = _coarse(at[shown], look.mask.shape, carving.grown[i])
    np.minimum.at(nearest, coarse, carving.depth[i, shown])
    front = carving.depth[i, shown] < nearest[coarse] + SURFACE * carving.edge
    soft = look.soft.reshape(-1)[flat]
    picked = look.image.reshape(-1, 3)[flat] / np.maximum(soft, DARK)[:, None]
    kept = front & (soft > 0.5) & (picked > DARK).all(1)
    colours[shown[kept]] = picked[kept]
    return colours


def _coarse(pixels: NDArray[np.int64], size: tuple[int, int], cell: int) -> NDArray[np.int64]:
    return (pixels[:, 1] // cell) * size[1] + pixels[:, 0] // cell


def judge_colours(
    scores: Mapping[str, Colours], limits: Limits, blamed: frozenset[str] = frozenset()
) -> list[Finding]:
    """Names the cameras whose colours differ.

    Args:
        scores: of `score_colours`.
        limits: how much they may.
        blamed: cameras whose masks do not fit; with any, colours say nothing.
    """
    off = {name: c for name, c in scores.items() if _worst(c) > limits.colour_ratio}
    if not off or len(scores) < 2 or blamed:
        return []
    told = [
        f"{name} " + ", ".join(f"{n} {v:.2f}" for n, v in zip(CHANNELS, c.judged, strict=True))
        for name, c in off.items()
    ]
    shared = all(c.gain is not None for c in off.values())
    where = "on surface that other cameras see too" if shared else "of the person's mean colour"
    doubt = "" if shared else "; seeing another side of the person does this as well"
    return [
        Finding(
            "warning", "colour",
            f"cameras differ in exposure or white balance (times the median camera's, {where}): "
            f"{'; '.join(told)}{doubt}. Whether training corrects it stands among the effects: "
            "effects.colour_correction=auto goes by a finer measure of its own, on always does",
        )
    ]  # fmt: skip


def _worst(colours: Colours) -> float:
    """The largest ratio, up or down."""
    return float(np.exp(np.abs(np.log(np.maximum(colours.judged, 1e-6))).max()))


def colour_table(scores: Mapping[str, Colours], limits: Limits) -> Table:
    """A row a camera."""
    rows, flagged = [], set()
    for i, (name, c) in enumerate(scores.items()):
        gain = "–" if c.gain is None else _triple(c.gain)
        rows.append((name, _triple(c.mean), _triple(c.ratio), gain))
        if _worst(c) > limits.colour_ratio:
            flagged.add((i, 2 if c.gain is None else 3))
    headers = ("camera", "mean RGB of the person", "to the median camera", "on shared surface")
    return Table(headers, tuple(rows), frozenset(flagged))


def _triple(values: Float) -> str:
    return " ".join(f"{v:.2f}" for v in values)
