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

from gsgan.splat import (
    ACCURACY,
    BACKENDS,
    Accuracy,
    gsplat_backend,
    resolve_backend,
)

Inputs = dict[str, Tensor]
Outputs = Mapping[str, Tensor]

NO_BACKEND = "-"  # for what the rasteriser takes no part in
RIGHT = "right"
WARNED = "warned"
REFUSED = "refused"
FINITE_ONLY = "finite only"
NOT_FINITE = "not finite"
STATUSES = (RIGHT, WARNED, REFUSED, FINITE_ONLY, NOT_FINITE)
# Modules of cases, in the order of the table; each has ``cases()``.
MODULES = (
    "gaussians",
    "scenes",
    "skeleton",
    "rotations",
    "lbs",
    "psi",
    "losses",
    "generator",
)


@dataclass(frozen=True)
class Tolerance:
    """How far float32 may be from float64."""

    # difference of an output, relative to its largest entry where that is > 1
    values: float = 1e-5
    # difference of an input's gradient, relative to its largest entry
    gradients: float = 1e-4

    def at(self, dtype: torch.dtype) -> Tolerance:
        """The same number of another type's roundings, but no less than float64 can reach."""
        part = torch.finfo(dtype).eps / torch.finfo(torch.float32).eps
        return Tolerance(
            max(self.values * part, 1e-10), max(self.gradients * part, 1e-9)
        )


@dataclass(frozen=True)
class Case:
    """One hard case; ``name`` and ``note`` are for readers of the table.

    Args:
        inputs: makes the inputs by name, in float64; every floating one gets a gradient.
        run: inputs → outputs by name; with ``settings`` it is called with a backend's name as well.
            Every output is compared, and the gradients of their weighted sum. May warn, or raise
            ValueError where the input must be refused.
        settings: of the rasteriser: the case runs on each backend that draws with them.
        same_numbers: whether float64 starts from the inputs as rounded to float32.
        gradient_floor: by input, a gradient below this counts as zero: only for gradients that are
            zero in exact arithmetic. ``note`` gives the reason.
        expect: the status that the case must get, one of ``STATUSES``.
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

    def build(
        self, dtype: torch.dtype, device: torch.device | str = "cpu"
    ) -> Inputs:
        """The inputs, floating ones rounded to ``dtype``."""
        return {
            k: v.to(device, dtype) if v.is_floating_point() else v.to(device)
            for k, v in self.inputs().items()
        }

    def backends(self, device: torch.device | str = "cpu") -> tuple[str, ...]:
        """The backends to compare one by one; ``("-",)`` where nothing is rasterised."""
        return (
            (NO_BACKEND,)
            if self.settings is None
            else drawing_backends(device, self.settings)
        )

    def outputs(self, inputs: Inputs, backend: str = "reference") -> Outputs:
        """Runs the case; the default is what others are compared with."""
        return (
            self.run(inputs)
            if self.settings is None
            else self.run(inputs, backend)
        )


def drawing_backends(
    device: torch.device | str = "cpu", settings: Accuracy = ACCURACY["high"]
) -> tuple[str, ...]:
    """The backends that keep to these settings on this device."""
    device = torch.device(device)
    names = (name for name in BACKENDS if name != "auto")
    found = [
        name
        for name in names
        if resolve_backend(name, device, settings)[0] == name
    ]
    if "gsplat" in found and gsplat_backend.differences(settings, device):
        found.remove("gsplat")
    return tuple(found)


def all_cases() -> tuple[Case, ...]:
    """Every hard case, by subject."""
    modules = (import_module(f"stability.cases.{name}") for name in MODULES)
    return tuple(case for module in modules for case in module.cases())


def compare_all(device: torch.device | str = "cpu") -> Iterator[Row]:
    """The rows of the table, float32, for every case and each of its backends."""
    for case in all_cases():
        for backend in case.backends(device):
            yield compare(case, torch.float32, device, backend)


class Row(NamedTuple):
    """The outcome of one case on one backend. The note ends with the message of a refusal or a
    warning."""

    case: str
    subject: str
    backend: str
    value_error: (
        float  # as in ``Tolerance``; NaN where nothing could be compared
    )
    gradient_error: float
    # the one with that gradient error; empty where all gradients are exact
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
    exact = {
        k: v.double() if v.is_floating_point() else v for k, v in inputs.items()
    }
    if not case.same_numbers:
        exact = case.build(torch.float64, device)
    value_error, gradient_error, worst = math.nan, math.nan, ""
    try:
        outputs, slopes, message = _run(case, inputs, backend)
    except ValueError as error:
        status, message = REFUSED, str(error)
    else:
        exact_outputs, exact_slopes, _ = _run(case, exact, "reference")
        floors, tolerance = case.gradient_floor or {}, case.tolerance.at(dtype)
        value_error = max(
            (
                _error(outputs[k], v, minimum=1.0)
                for k, v in exact_outputs.items()
            )
        )
        errors = {
            k: _error(slopes[k], v, floor=floors.get(k, 0))
            for k, v in exact_slopes.items()
        }
        worst = max(errors, key=errors.__getitem__)
        gradient_error = errors[worst]
        worst = worst if gradient_error > 0 else ""
        pairs = [(outputs[k], v) for k, v in exact_outputs.items()]
        pairs += [(slopes[k], v) for k, v in exact_slopes.items()]
        if not all(
            (got.isfinite() | ~want.isfinite()).all() for got, want in pairs
        ):
            status = NOT_FINITE
        elif (
            value_error <= tolerance.values
            and gradient_error <= tolerance.gradients
        ):
            status = WARNED if message else RIGHT
        else:
            status = FINITE_ONLY
    note = " ".join(
        x for x in (case.note, f"Message: {message}" if message else "") if x
    )
    return Row(
        case.name,
        case.subject,
        backend,
        value_error,
        gradient_error,
        worst,
        status,
        case.expect,
        note,
    )


def assert_as_expected(
    case: Case, backend: str = NO_BACKEND, dtype: torch.dtype = torch.float32
) -> None:
    """The case gets the status that it must get; a failure prints the row of the table.

    In float64 nothing is rounded enough to be wrong: a case expected to be wrong is right there.
    """
    row = compare(case, dtype, "cpu", backend)
    wrong_in_float32 = case.expect == FINITE_ONLY and dtype == torch.float64
    assert row.status == (RIGHT if wrong_in_float32 else case.expect), (
        f"{row}\ntolerance: {case.tolerance.at(dtype)}"
    )


def _run(
    case: Case, inputs: Inputs, backend: str
) -> tuple[Inputs, Inputs, str]:
    """Outputs, gradients by input, and the text of warnings."""
    leaves = {
        k: v.clone().requires_grad_(v.is_floating_point())
        for k, v in inputs.items()
    }
    generator = torch.Generator().manual_seed(0)
    total = torch.zeros((), dtype=torch.float64)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        outputs = dict(case.outputs(leaves, backend))
        for _, value in sorted(outputs.items()):
            # Drawn for every output, so that weights do not depend on which ones carry a graph.
            weights = torch.randn(value.shape, generator=generator).to(
                value.device
            )
            if value.requires_grad:
                total = (
                    total.to(value.device)
                    + (value.double() * weights.double()).sum()
                )
        if total.requires_grad:
            total.backward()
    gradients = {
        name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        for name, leaf in leaves.items()
        if leaf.is_floating_point()
    }
    message = " ".join(
        str(w.message) for w in caught if issubclass(w.category, UserWarning)
    )
    return {k: v.detach() for k, v in outputs.items()}, gradients, message


def _error(
    got: Tensor, want: Tensor, *, minimum: float = 0.0, floor: float = 0.0
) -> float:
    """Largest difference relative to ``max(least, |want|)``; equal infinities and NaNs differ by 0.

    A difference where both are below ``floor`` is none.
    """
    got, want = got.double(), want.double()
    same = (got == want) | (got.isnan() & want.isnan())
    difference = (
        (got - want).abs().nan_to_num(nan=math.inf, posinf=math.inf)[~same]
    )
    largest = [
        float(x[x.isfinite()].abs().amax()) if x.isfinite().any() else 0
        for x in (got, want)
    ]
    if not difference.numel() or max(largest) < floor:
        return 0.0
    scale = max(minimum, largest[1])
    return float(difference.max()) / scale if scale > 0 else math.inf
