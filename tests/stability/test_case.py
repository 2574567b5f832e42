"""The judge itself: it finds what is wrong, and only that."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from torch import Tensor

from gsgan.bench.cases import VERDICTS, Case, Tolerance, all_cases, judge, registry, table


class Spoiled(torch.autograd.Function):
    """The identity, with a gradient multiplied by a number."""

    @staticmethod
    def forward(ctx, x: Tensor, factor: float) -> Tensor:
        ctx.factor = factor
        return x.clone()

    @staticmethod
    def backward(ctx, grad: Tensor):
        return grad * ctx.factor, None


def case(run, **options) -> Case:
    """A case with inputs x and y."""

    def build(dtype, device):
        x = torch.tensor([1.1, -2.3, 0.7], dtype=torch.float64)
        return {"x": x.to(device, dtype), "y": (x + 1).to(device, dtype), "n": torch.tensor([1, 2])}

    return Case(name="a case", subject="the judge", build=build, run=run, **options)


def only_in_float32(x: Tensor, then: Tensor) -> Tensor:
    return then if x.dtype == torch.float32 else x


def test_right():
    row = judge(case(lambda i: {"z": i["x"].exp() * i["y"]}))
    assert row.verdict == "right"
    assert row.as_expected
    assert 0 < row.value_error < 1e-6
    assert 0 < row.gradient_error < 1e-6
    assert row.dtype == "float32"


def test_a_wrong_value_is_found():
    row = judge(case(lambda i: {"z": i["y"], "w": only_in_float32(i["x"], 1.1 * i["x"])}))
    assert row.verdict == "finite only"
    assert not row.as_expected
    assert row.value_error == pytest.approx(0.1, rel=1e-5)


def test_a_wrong_gradient_is_found_and_its_input_named():
    row = judge(case(lambda i: {"z": i["x"] * only_in_float32(i["y"], Spoiled.apply(i["y"], 1.5))}))
    assert row.verdict == "finite only"
    assert row.value_error < 1e-6
    assert row.gradient_error == pytest.approx(0.5, rel=1e-5)
    assert row.worst_input == "y"


@pytest.mark.parametrize("factor", [math.nan, math.inf])
def test_a_gradient_that_is_not_finite_is_found(factor):
    row = judge(case(lambda i: {"z": only_in_float32(i["x"], Spoiled.apply(i["x"], factor))}))
    assert row.verdict == "not finite"
    assert row.finite_values
    assert not row.finite_gradients


def test_a_gradient_where_there_is_none_is_infinitely_wrong_but_for_a_floor():
    def leaky(inputs):
        leak = 1e-9 if inputs["y"].dtype == torch.float32 else 0.0
        return {"z": inputs["x"] + leak * inputs["y"]}

    row = judge(case(leaky))
    assert row.verdict == "finite only"
    assert row.gradient_error == math.inf
    assert row.worst_input == "y"
    assert judge(case(leaky, gradient_floor={"y": 1e-6})).verdict == "right"


def test_a_value_error_is_a_refusal_and_the_note_says_what_it_said():
    def run(inputs):
        raise ValueError("run: x must be nicer")

    row = judge(case(run, expect="refused", note="By design."))
    assert row.verdict == "refused"
    assert row.as_expected
    assert math.isnan(row.value_error)
    assert row.note == "By design. It says: run: x must be nicer"


def test_another_error_is_not_hidden():
    def run(inputs):
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError, match="a bug"):
        judge(case(run))


def test_a_warning_is_a_verdict():
    def run(inputs):
        warnings.warn("x is odd", stacklevel=1)
        return {"z": inputs["x"]}

    row = judge(case(run))
    assert row.verdict == "warned"
    assert row.note == "It says: x is odd"


def test_a_warning_does_not_hide_a_wrong_result():
    def run(inputs):
        warnings.warn("x is odd", stacklevel=1)
        return {"z": only_in_float32(inputs["x"], 1.1 * inputs["x"])}

    row = judge(case(run))
    assert row.verdict == "finite only"
    assert row.note == "It says: x is odd"


def test_equal_infinities_are_right_and_others_are_not():
    def infinite(sign):
        return lambda i: {"psnr": torch.full((2,), sign(i["x"].dtype) * math.inf), "z": i["x"]}

    assert judge(case(infinite(lambda dtype: 1))).verdict == "right"
    other = judge(case(infinite(lambda dtype: 1 if dtype == torch.float32 else -1)))
    assert other.verdict == "finite only"
    assert other.value_error == math.inf


def test_rounding_of_the_inputs_counts_only_where_asked():
    def far(inputs):
        return {"z": (inputs["x"] + 0.1).sin()}

    tight = Tolerance(values=1e-9, gradients=1.0)
    assert judge(case(far, tolerance=tight)).verdict == "finite only"

    def exactly_representable(inputs):
        return {"z": inputs["x"].double() * 1.0}

    assert judge(case(exactly_representable, tolerance=tight)).verdict == "right"
    rounded = judge(case(exactly_representable, tolerance=tight, same_numbers=False))
    assert rounded.verdict == "finite only"
    assert 1e-9 < rounded.value_error < 1e-7


def test_tolerances_shrink_with_the_rounding_but_not_to_nothing():
    tolerance = Tolerance(1.0, 1e-4)
    assert tolerance.at(torch.float32) == tolerance
    assert tolerance.at(torch.float64).values == pytest.approx(2**-29)
    assert tolerance.at(torch.float64).gradients == pytest.approx(1e-9)


def test_the_table_has_a_row_for_each_case_and_backend(monkeypatch):
    plain = case(lambda i: {"z": i["x"]})
    drawn = next(c for c in all_cases() if c.name == "a picture of 1 x 1")
    monkeypatch.setattr(registry, "all_cases", lambda: (plain, drawn))
    rows = table("cpu")
    backends = ["-", *drawn.backends(torch.device("cpu"))]
    assert [row.backend for row in rows] == backends
    assert all(row.verdict == "right" for row in rows)


def test_every_case_has_a_name_of_its_own_and_a_known_verdict():
    cases = all_cases()
    names = [(c.subject, c.name) for c in cases]
    assert len(set(names)) == len(names) > 70
    assert all(c.expect in VERDICTS for c in cases)
