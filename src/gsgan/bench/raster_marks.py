"""What the rasteriser must reach, held against what was measured in the same run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from gsgan.bench.raster_cell import Row
from gsgan.bench.tables import number
from gsgan.utils.timing import slope

TIMES = {"forward_ms": "forward", "both_ms": "forward + backward"}


@dataclass(frozen=True)
class Marks:
    """The least, or most, of each figure.

    Args:
        native_forward, native_both: times that native is faster than torch, at ``standard``.
        torch_dense: times that torch at ``standard`` is faster than dense float32 evaluation.
        high_standard: times that ``high`` takes of ``standard``, native.
        high_value: largest value error of ``high``.
        high_gradient: largest relative gradient error of ``high``.
        torch_memory_mb: peak memory of torch.
        growth: exponent of time in Gaussians and in pixels; 1 is linear.
    """

    native_forward: float
    native_both: float
    torch_dense: float
    high_standard: float
    high_value: float
    high_gradient: float
    torch_memory_mb: float
    growth: float


@dataclass(frozen=True)
class Line:
    """One line of the verdict; ``reached`` is None where nothing was measured."""

    what: str
    wanted: str
    found: str
    reached: bool | None

    @property
    def verdict(self) -> str:
        """For people."""
        return {None: "not measured", True: "reached", False: "missed"}[self.reached]


def verdict(
    rows: Sequence[Row],
    reference: dict[str, int],
    marks: Marks,
    rounding: float,
    auto: dict[str, str],
) -> list[Line]:
    """Every mark with what was found.

    Args:
        rows: of one run.
        reference: ``gaussians`` and ``size`` that the marks are about.
        marks: what is wanted.
        rounding: of float32, on top of the proven bound.
        auto: the backend that ``auto`` takes, by setting.
    """
    here = [row for row in rows if {"gaussians": row.gaussians, "size": row.size} == reference]
    lines: list[Line] = []
    for channels in sorted({row.channels for row in here}):
        lines += _ratios([row for row in here if row.channels == channels], channels, marks)
    memory = _largest(here, "torch", None, lambda row: row.memory_mb)
    lines.append(_at_most("torch: peak memory, MB", memory, marks.torch_memory_mb))
    high = [row for row in rows if row.setting == "high"]
    value = _largest(high, None, "high", lambda row: row.value_max)
    gradient = _largest(high, None, "high", lambda row: row.gradient)
    lines.append(_at_most("high: largest value error", value, marks.high_value))
    lines.append(_at_most("high: worst gradient error, relative", gradient, marks.high_gradient))
    beyond = _largest(rows, None, None, lambda row: row.beyond)
    lines.append(_at_most("every setting: error above its proven bound", beyond, rounding))
    if "standard" in auto:
        taken = auto["standard"]
        lines.append(Line("auto, standard: backend", "native", taken, taken == "native"))
    return lines + _growth_lines(rows, reference, marks.growth)


def growth(
    rows: Sequence[Row], reference: dict[str, int], axis: str, time: str
) -> dict[tuple[str, str, int], tuple[list[float], list[float]]]:
    """Curves of time against one axis, the other at the reference.

    Args:
        rows: of one run.
        reference: ``gaussians`` and ``size``.
        axis: ``gaussians`` or ``size``; the curve's x is Gaussians or pixels.
        time: ``forward_ms`` or ``both_ms``.

    Returns:
        x and y by (backend, setting, channels), in order of x.
    """
    other = "size" if axis == "gaussians" else "gaussians"
    curves: dict[tuple[str, str, int], tuple[list[float], list[float]]] = {}
    for row in sorted(rows, key=lambda row: int(getattr(row, axis))):
        y = getattr(row, time)
        if getattr(row, other) == reference[other] and y is not None and row.backend != "dense":
            x = getattr(row, axis)
            curve = curves.setdefault((row.backend, row.setting, row.channels), ([], []))
            curve[0].append(float(x if axis == "gaussians" else x * x))
            curve[1].append(y)
    return curves


def _ratios(here: Sequence[Row], channels: int, marks: Marks) -> list[Line]:
    """Side by side at one number of channels."""
    found = {(row.backend, row.setting): row for row in here}
    native, torch = found.get(("native", "standard")), found.get(("torch", "standard"))
    high, dense = found.get(("native", "high")), found.get(("dense", "float32"))
    lines = []
    for time, shown in TIMES.items():
        at = f"C={channels}, {shown}"
        least = marks.native_forward if time == "forward_ms" else marks.native_both
        lines.append(_at_least(f"native over torch, {at}", _ratio(torch, native, time), least))
        if dense is not None:
            lines.append(
                _at_least(
                    f"torch over dense float32, {at}", _ratio(dense, torch, time), marks.torch_dense
                )
            )
        lines.append(
            _at_most(
                f"native: high over standard, {at}", _ratio(high, native, time), marks.high_standard
            )
        )
    return lines


def _growth_lines(rows: Sequence[Row], reference: dict[str, int], most: float) -> list[Line]:
    """The steepest of a backend's curves along each axis."""
    lines = []
    backends = sorted({row.backend for row in rows} - {"dense"})
    for axis, shown in (("gaussians", "Gaussians"), ("size", "pixels")):
        for backend in backends:
            exponents = [
                exponent
                for time in TIMES
                for key, curve in growth(rows, reference, axis, time).items()
                if key[0] == backend and key[1] in ("high", "standard")
                if (exponent := slope(*curve)) is not None
            ]
            worst = max(exponents, default=None)
            lines.append(_at_most(f"{backend}: exponent of time in {shown}", worst, most))
    return lines


def _ratio(slow: Row | None, fast: Row | None, time: str) -> float | None:
    a, b = (None if row is None else getattr(row, time) for row in (slow, fast))
    return None if a is None or b is None else a / b


def _largest(
    rows: Sequence[Row],
    backend: str | None,
    setting: str | None,
    of: Callable[[Row], float | None],
) -> float | None:
    values = [
        value
        for row in rows
        if backend in (None, row.backend) and setting in (None, row.setting)
        if (value := of(row)) is not None
    ]
    return max(values, default=None)


def _at_least(what: str, found: float | None, wanted: float) -> Line:
    reached = None if found is None else found >= wanted
    return Line(what, f"at least {wanted:g}", number(found), reached)


def _at_most(what: str, found: float | None, wanted: float) -> Line:
    reached = None if found is None else found <= wanted
    return Line(what, f"at most {wanted:g}", number(found), reached)
