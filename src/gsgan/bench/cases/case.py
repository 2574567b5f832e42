"""A hard case and its verdict: float32 against float64, values and gradients.

How to write a case: ``build`` makes the inputs, ``run`` turns them into named outputs, and
``judge`` does the rest. Each module of cases lists its own in one tuple (``GAUSSIANS``, ...), and
``gsgan.bench.cases.registry`` joins the tuples.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

Inputs = dict[str, Tensor]
Outputs = Mapping[str, Tensor]

NO_BACKEND = "-"
"""Stands for the backend of a subject that has none."""

RIGHT = "right"
FINITE_ONLY = "finite only"
NOT_FINITE = "not finite"
REFUSED = "refused"
WARNED = "warned"
VERDICTS = (RIGHT, WARNED, REFUSED, FINITE_ONLY, NOT_FINITE)

# Tolerances are stated for float32; other types are allowed the same number of their own roundings,
# up to this much per 1: a float64 result is never asked for more than float64 can give.
_LEAST_TOLERANCE = 1e-10


@dataclass(frozen=True)
class Tolerance:
    """How far float32 may be from float64 and still be called right.

    Args:
        values: largest difference of an output, relative to its largest entry where that is > 1.
        gradients: largest difference of an input's gradient, relative to its largest entry.
    """

    values: float = 1e-5
    gradients: float = 1e-4

    def at(self, dtype: torch.dtype) -> Tolerance:
        """The same tolerance for another type, in proportion to its rounding."""
        part = torch.finfo(dtype).eps / torch.finfo(torch.float32).eps
        values, gradients = (x * part for x in (self.values, self.gradients))
        return Tolerance(max(values, _LEAST_TOLERANCE), max(gradients, 10 * _LEAST_TOLERANCE))


@dataclass(frozen=True, kw_only=True)
class Case:
    """One hard case.

    Args:
        name: a few plain words; unique together with ``subject``.
        subject: what is tested: ``Gaussians``, ``scenes``, ``skeleton``, ...
        build: ``(dtype, device)`` → the inputs by name, detached. Computes in float64 and rounds
            at the end. Every floating input gets a gradient, the others are passed as they are.
        run: the inputs → the outputs by name. Every output is compared; those that are floating
            and depend on an input are also weighted and summed to the scalar whose gradients are
            compared. May emit a warning or raise ValueError where the code refuses by design.
        tolerance: at float32.
        same_numbers: whether the float64 judge starts from the inputs as rounded to float32 (what
            the code adds is judged), or from inputs built in float64 (the rounding of the inputs
            is judged too).
        gradient_floor: by input, a gradient whose largest entry is below this counts as zero:
            only for gradients that are zero in exact arithmetic. State the reason in ``note``.
        expect: the verdict that the case is to get, one of ``VERDICTS``.
        note: what a reader of the table should know; empty where the name says all.
    """

    name: str
    subject: str
    build: Callable[[torch.dtype, torch.device], Inputs]
    run: Callable[[Inputs], Outputs]
    tolerance: Tolerance = Tolerance()
    same_numbers: bool = True
    gradient_floor: Mapping[str, float] | None = None
    expect: str = RIGHT
    note: str = ""

    def backends(self, device: torch.device) -> tuple[str, ...]:
        """The backends to judge one by one; ``("-",)`` where the subject has none."""
        return (NO_BACKEND,)

    def outputs(self, inputs: Inputs, backend: str) -> Outputs:
        """Runs the case on one backend."""
        return self.run(inputs)

    def truth(self, inputs: Inputs) -> Outputs:
        """What the judge computes from float64 inputs."""
        return self.run(inputs)


@dataclass(frozen=True)
class Row:
    """The verdict on one case, type and backend.

    Args:
        case: its name.
        subject: its subject.
        backend: the rasteriser's backend, or ``-``.
        dtype: ``float32``, ``float64``, ...
        value_error: see ``Tolerance.values``; NaN where nothing could be compared.
        gradient_error: the worst input's, see ``Tolerance.gradients``; NaN likewise.
        worst_input: the input that ``gradient_error`` is of; empty where every gradient is exact.
        finite_values: whether outputs are finite wherever the judge's are.
        finite_gradients: likewise for gradients.
        verdict: ``right`` (values and gradients within tolerance), ``warned`` (right, and
            the code said that something is odd), ``refused`` (ValueError), ``finite only`` or
            ``not finite``.
        expected: the verdict that the case is to get.
        note: the case's note; for ``refused`` and ``warned`` also what the code said.
    """

    case: str
    subject: str
    backend: str
    dtype: str
    value_error: float
    gradient_error: float
    worst_input: str
    finite_values: bool
    finite_gradients: bool
    verdict: str
    expected: str
    note: str

    @property
    def as_expected(self) -> bool:
        """Whether the verdict is the one the case is to get."""
        return self.verdict == self.expected


@dataclass(frozen=True)
class _Result:
    """Outputs, gradients by input, and what was warned of."""

    outputs: dict[str, Tensor]
    gradients: dict[str, Tensor]
    warned: str


def judge(
    case: Case,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str = "cpu",
    backend: str = NO_BACKEND,
) -> Row:
    """Runs a case in ``dtype`` and in float64 and compares values and gradients.

    Convention: gradients are those of one scalar, the outputs weighted by seeded normal numbers,
    the same in both runs. An input's gradient error is 0 where both gradients are 0, and infinite
    where only the judge's is.

    Args:
        case: what to run.
        dtype: of the inputs.
        device: where to run.
        backend: one of ``case.backends(device)``.

    Returns:
        The row of the table.
    """
    device = torch.device(device)
    inputs = case.build(dtype, device)
    exact = _as_float64(inputs) if case.same_numbers else case.build(torch.float64, device)
    try:
        got = _gradients_of(lambda x: case.outputs(x, backend), inputs)
    except ValueError as error:
        return _row(case, dtype, backend, verdict=REFUSED, said=str(error))
    want = _gradients_of(case.truth, exact)
    return _compare(case, dtype, backend, got, want)


def _as_float64(inputs: Inputs) -> Inputs:
    return {k: v.double() if v.is_floating_point() else v for k, v in inputs.items()}


def _gradients_of(run: Callable[[Inputs], Outputs], inputs: Inputs) -> _Result:
    leaves = {
        name: value.detach().clone().requires_grad_() if value.is_floating_point() else value
        for name, value in inputs.items()
    }
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        outputs = dict(run(leaves))
        total = _weighted_sum(outputs)
        if total is not None:
            total.backward()
    gradients = {
        name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
        for name, leaf in leaves.items()
        if leaf.is_floating_point()
    }
    said = " ".join(str(w.message) for w in caught if issubclass(w.category, UserWarning))
    return _Result({k: v.detach() for k, v in outputs.items()}, gradients, said)


def _weighted_sum(outputs: Outputs) -> Tensor | None:
    """A scalar that every output enters with a weight of its own, or None without a graph."""
    parts = []
    generator = torch.Generator().manual_seed(0)
    for _, value in sorted(outputs.items()):
        # Drawn for every output, so that the weights do not depend on which ones carry a graph.
        weights = torch.randn(value.shape, generator=generator, dtype=torch.float32)
        if value.requires_grad:
            parts.append((value.double() * weights.to(value.device).double()).sum())
    return torch.stack(parts).sum() if parts else None


def _compare(case: Case, dtype: torch.dtype, backend: str, got: _Result, want: _Result) -> Row:
    values = {k: _error(got.outputs[k], want.outputs[k], least=1.0) for k in want.outputs}
    floors = case.gradient_floor or {}
    gradients = {
        k: _error(got.gradients[k], want.gradients[k], floor=floors.get(k, 0.0))
        for k in want.gradients
    }
    worst = max(gradients, key=lambda k: gradients[k], default="")
    value_error = max(values.values(), default=0.0)
    gradient_error = gradients.get(worst, 0.0)
    finite_values = _finite_where(got.outputs, want.outputs)
    finite_gradients = _finite_where(got.gradients, want.gradients)
    tolerance = case.tolerance.at(dtype)
    if not (finite_values and finite_gradients):
        verdict = NOT_FINITE
    elif value_error <= tolerance.values and gradient_error <= tolerance.gradients:
        verdict = WARNED if got.warned else RIGHT
    else:
        verdict = FINITE_ONLY
    return _row(
        *(case, dtype, backend),
        verdict=verdict,
        value_error=value_error,
        gradient_error=gradient_error,
        worst_input=worst if gradient_error > 0 else "",
        finite_values=finite_values,
        finite_gradients=finite_gradients,
        said=got.warned,
    )


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


def _finite_where(got: dict[str, Tensor], want: dict[str, Tensor]) -> bool:
    return all(
        got[k].shape == want[k].shape and bool((got[k].isfinite() | ~want[k].isfinite()).all())
        for k in want
    )


def _row(
    case: Case,
    dtype: torch.dtype,
    backend: str,
    *,
    verdict: str,
    said: str = "",
    value_error: float = math.nan,
    gradient_error: float = math.nan,
    worst_input: str = "",
    finite_values: bool = True,
    finite_gradients: bool = True,
) -> Row:
    return Row(
        case=case.name,
        subject=case.subject,
        backend=backend,
        dtype=str(dtype).removeprefix("torch."),
        value_error=value_error,
        gradient_error=gradient_error,
        worst_input=worst_input,
        finite_values=finite_values,
        finite_gradients=finite_gradients,
        verdict=verdict,
        expected=case.expect,
        note=" ".join(x for x in (case.note, f"It says: {said}" if said else "") if x),
    )
