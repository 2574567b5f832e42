"""A hard case, and how its float32 result is compared with float64: values and gradients."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import NamedTuple

import torch
from torch import Tensor

from gsgan.splat import ACCURACY, BACKENDS, Accuracy, gsplat_backend, resolve_backend

Inputs = dict[str, Tensor]
Outputs = Mapping[str, Tensor]

NO_BACKEND = "-"
"""In place of a backend, for what the rasteriser takes no part in."""

RIGHT = "right"
WARNED = "warned"
REFUSED = "refused"
FINITE_ONLY = "finite only"
NOT_FINITE = "not finite"
STATUSES = (RIGHT, WARNED, REFUSED, FINITE_ONLY, NOT_FINITE)

MODULES = ("gaussians", "scenes", "skeleton", "rotations", "lbs", "psi", "losses", "generator")
"""Modules of cases, in the order of the table; each has ``cases()``."""

# Tolerances are stated for float32. Other types get the same number of their own roundings, but not
# less than this, which float64 arithmetic can reach.
_LEAST_TOLERANCE = 1e-10


@dataclass(frozen=True)
class Tolerance:
    """How far float32 may be from float64.

    Args:
        values: largest difference of an output, relative to its largest entry where that is > 1.
        gradients: largest difference of an input's gradient, relative to its largest entry.
    """

    values: float = 1e-5
    gradients: float = 1e-4

    def at(self, dtype: torch.dtype) -> Tolerance:
        """The same tolerance for another type, in proportion to its rounding."""
        part = torch.finfo(dtype).eps / torch.finfo(torch.float32).eps
        return Tolerance(
            max(self.values * part, _LEAST_TOLERANCE),
            max(self.gradients * part, 10 * _LEAST_TOLERANCE),
        )


@dataclass(frozen=True)
class Case:
    """One hard case.

    Args:
        subject: what is tested: ``Gaussians``, ``scenes``, ``skeleton``, ...
        name: a few plain words; unique within the subject.
        inputs: makes the inputs by name, in float64. Every floating input gets a gradient, the
            others are passed as they are.
        run: inputs → outputs by name; where ``settings`` are given it is called with the name of a
            backend as well. Every output is compared. Those that depend on an input are weighted
            and summed to the scalar whose gradients are compared. May warn, or raise ValueError
            where the input must be refused.
        settings: of the rasteriser: the case runs on each backend that draws with them.
        tolerance: at float32.
        same_numbers: whether float64 starts from the inputs as rounded to float32 (only the
            rounding of the code counts) or from the inputs in float64.
        gradient_floor: by input, a gradient whose largest entry is below this counts as zero: only
            for gradients that are zero in exact arithmetic. ``note`` gives the reason.
        expect: the status that the case must get, one of ``STATUSES``.
        note: for readers of the table; empty where the name says all.
    """

    subject: str
    name: str
    inputs: Callable[[], Inputs]
    run: Callable[..., Outputs]
    settings: Accuracy | None = None
    tolerance: Tolerance = Tolerance()
    same_numbers: bool = True
    gradient_floor: Mapping[str, float] | None = None
    expect: str = RIGHT
    note: str = ""

    def build(self, dtype: torch.dtype, device: torch.device | str = "cpu") -> Inputs:
        """The inputs, floating ones rounded to ``dtype``."""
        return {
            k: v.to(device, dtype) if v.is_floating_point() else v.to(device)
            for k, v in self.inputs().items()
        }

    def backends(self, device: torch.device | str = "cpu") -> tuple[str, ...]:
        """The backends to compare one by one; ``("-",)`` where nothing is rasterised."""
        return (NO_BACKEND,) if self.settings is None else drawing_backends(device, self.settings)

    def outputs(self, inputs: Inputs, backend: str = "reference") -> Outputs:
        """Runs the case; the default is what others are compared with."""
        return self.run(inputs) if self.settings is None else self.run(inputs, backend)


def drawing_backends(
    device: torch.device | str = "cpu", settings: Accuracy = ACCURACY["high"]
) -> tuple[str, ...]:
    """The backends that keep to these settings on this device."""
    device = torch.device(device)
    names = (name for name in BACKENDS if name != "auto")
    found = [name for name in names if resolve_backend(name, device, settings)[0] == name]
    if "gsplat" in found and gsplat_backend.differences(settings, device):
        found.remove("gsplat")
    return tuple(found)


def all_cases() -> tuple[Case, ...]:
    """Every hard case, by subject. Imports the modules only now: some load networks."""
    modules = (import_module(f"stability.cases.{name}") for name in MODULES)
    return tuple(case for module in modules for case in module.cases())


def compare_all(device: torch.device | str = "cpu") -> Iterator[Row]:
    """The rows of the table, float32, for every case and each of its backends."""
    for case in all_cases():
        for backend in case.backends(device):
            yield compare(case, torch.float32, device, backend)


class Row(NamedTuple):
    """The outcome of one case on one backend.

    ``value_error`` and ``gradient_error`` are as in ``Tolerance``, NaN where nothing could be
    compared; ``worst_input`` is the input of the latter, empty where all gradients are exact. The
    status is ``right`` (within tolerance), ``warned`` (right, with a warning), ``refused``
    (ValueError), ``finite only`` or ``not finite``. The note ends with the message of a refusal
    or a warning.
    """

    case: str
    subject: str
    backend: str
    value_error: float
    gradient_error: float
    worst_input: str
    status: str
    expected: str
    note: str


def compare(
    case: Case,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
    backend: str = NO_BACKEND,
) -> Row:
    """Runs a case in ``dtype`` and in float64 and compares values and gradients.

    Convention: gradients are those of one scalar, the outputs weighted by the same seeded normal
    numbers in both runs. An input's gradient error is 0 where both gradients are 0, and infinite
    where only the one of float64 is.
    """
    inputs = case.build(dtype, device)
    exact = {k: v.double() if v.is_floating_point() else v for k, v in inputs.items()}
    if not case.same_numbers:
        exact = case.build(torch.float64, device)
    try:
        outputs, slopes, message = _run(case, inputs, backend)
    except ValueError as error:
        value_error = gradient_error = math.nan
        status, message, worst = REFUSED, str(error), ""
    else:
        exact_outputs, exact_slopes, _ = _run(case, exact, "reference")
        floors = case.gradient_floor or {}
        values = [_error(outputs[k], v, least=1.0) for k, v in exact_outputs.items()]
        gradients = {
            k: _error(slopes[k], v, floor=floors.get(k, 0.0)) for k, v in exact_slopes.items()
        }
        value_error = max(values, default=0.0)
        worst = max(gradients, key=gradients.__getitem__, default="")
        gradient_error = gradients.get(worst, 0.0)
        worst = worst if gradient_error > 0 else ""
        tolerance = case.tolerance.at(dtype)
        if not (_finite(outputs, exact_outputs) and _finite(slopes, exact_slopes)):
            status = NOT_FINITE
        elif value_error <= tolerance.values and gradient_error <= tolerance.gradients:
            status = WARNED if message else RIGHT
        else:
            status = FINITE_ONLY
    note = " ".join(x for x in (case.note, f"Message: {message}" if message else "") if x)
    return Row(
        *(case.name, case.subject, backend, value_error, gradient_error, worst),
        *(status, case.expect, note),
    )


def _run(
    case: Case, inputs: Inputs, backend: str
) -> tuple[dict[str, Tensor], dict[str, Tensor], str]:
    """Outputs, gradients by input, and the text of warnings."""
    leaves = {
        name: value.detach().clone().requires_grad_() if value.is_floating_point() else value
        for name, value in inputs.items()
    }
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        outputs = dict(case.outputs(leaves, backend))
        total = _weighted_sum(outputs)
        if total is not None:
            total.backward()
    gradients = {
        name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        for name, leaf in leaves.items()
        if leaf.is_floating_point()
    }
    message = " ".join(str(w.message) for w in caught if issubclass(w.category, UserWarning))
    return {k: v.detach() for k, v in outputs.items()}, gradients, message


def _weighted_sum(outputs: Outputs) -> Tensor | None:
    """A scalar that every output enters with weights, or None without a graph."""
    parts = []
    generator = torch.Generator().manual_seed(0)
    for _, value in sorted(outputs.items()):
        # Drawn for every output, so that the weights do not depend on which ones carry a graph.
        weights = torch.randn(value.shape, generator=generator, dtype=torch.float32)
        if value.requires_grad:
            parts.append((value.double() * weights.to(value.device).double()).sum())
    return torch.stack(parts).sum() if parts else None


def _error(got: Tensor, want: Tensor, *, least: float = 0.0, floor: float = 0.0) -> float:
    """Largest difference relative to ``max(least, |want|)``; equal infinities and NaNs differ by 0.

    A difference where both are below ``floor`` is none.
    """
    if got.shape != want.shape:
        return math.inf
    got, want = got.detach().double(), want.detach().double()
    same = (got == want) | (got.isnan() & want.isnan())
    difference = torch.where(
        same, 0.0, (got - want).abs().nan_to_num(nan=math.inf, posinf=math.inf)
    )
    if not difference.any() or max(_largest(got), _largest(want)) < floor:
        return 0.0
    scale = max(least, _largest(want))
    return float(difference.max()) / scale if scale > 0 else math.inf


def _largest(x: Tensor) -> float:
    finite = x[x.isfinite()]
    return float(finite.abs().max()) if finite.numel() else 0.0


def _finite(got: dict[str, Tensor], want: dict[str, Tensor]) -> bool:
    """Whether entries are finite wherever those of float64 are."""
    return all(
        got[k].shape == want[k].shape and bool((got[k].isfinite() | ~want[k].isfinite()).all())
        for k in want
    )
