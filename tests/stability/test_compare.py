"""The comparison with float64: it finds what is wrong, and only that."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from torch import Tensor

from stability.cases import case as module
from stability.cases.case import Case, Tolerance, all_cases, compare, compare_all


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

    x = torch.tensor([1.1, -2.3, 0.7], dtype=torch.float64)
    inputs = {"x": x, "y": x + 1, "n": torch.tensor([1, 2])}
    return Case("a subject", "a case", inputs.copy, run, **options)


def only_in_float32(x: Tensor, then: Tensor) -> Tensor:
    return then if x.dtype == torch.float32 else x


def test_right():
    row = compare(case(lambda i: {"z": i["x"].exp() * i["y"]}))
    assert row.status == "right"
    assert row.status == row.expected
    assert 0 < row.value_error < 1e-6
    assert 0 < row.gradient_error < 1e-6


def test_a_wrong_value_is_found():
    row = compare(case(lambda i: {"z": i["y"], "w": only_in_float32(i["x"], 1.1 * i["x"])}))
    assert row.status == "finite only"
    assert row.status != row.expected
    assert row.value_error == pytest.approx(0.1, rel=1e-5)


def test_a_wrong_gradient_is_found_and_its_input_named():
    row = compare(
        case(lambda i: {"z": i["x"] * only_in_float32(i["y"], Spoiled.apply(i["y"], 1.5))})
    )
    assert row.status == "finite only"
    assert row.value_error < 1e-6
    assert row.gradient_error == pytest.approx(0.5, rel=1e-5)
    assert row.worst_input == "y"


@pytest.mark.parametrize("factor", [math.nan, math.inf])
def test_a_gradient_that_is_not_finite_is_found(factor):
    row = compare(case(lambda i: {"z": only_in_float32(i["x"], Spoiled.apply(i["x"], factor))}))
    assert row.status == "not finite"


def test_a_gradient_where_there_is_none_is_infinitely_wrong_but_for_a_floor():
    def leaky(inputs):
        leak = 1e-9 if inputs["y"].dtype == torch.float32 else 0.0
        return {"z": inputs["x"] + leak * inputs["y"]}

    row = compare(case(leaky))
    assert row.status == "finite only"
    assert row.gradient_error == math.inf
    assert row.worst_input == "y"
    assert compare(case(leaky, gradient_floor={"y": 1e-6})).status == "right"


def test_a_value_error_is_a_refusal_and_its_message_is_in_the_note():
    def run(inputs):
        raise ValueError("run: x must be nicer")

    row = compare(case(run, expect="refused", note="By design."))
    assert row.status == "refused"
    assert row.status == row.expected
    assert math.isnan(row.value_error)
    assert row.note == "By design. Message: run: x must be nicer"


def test_another_error_is_not_hidden():
    def run(inputs):
        raise RuntimeError("a bug")

    with pytest.raises(RuntimeError, match="a bug"):
        compare(case(run))


def test_a_warning_is_a_status():
    def run(inputs):
        warnings.warn("x is odd", stacklevel=1)
        return {"z": inputs["x"]}

    row = compare(case(run))
    assert row.status == "warned"
    assert row.note == "Message: x is odd"


def test_a_warning_does_not_hide_a_wrong_result():
    def run(inputs):
        warnings.warn("x is odd", stacklevel=1)
        return {"z": only_in_float32(inputs["x"], 1.1 * inputs["x"])}

    row = compare(case(run))
    assert row.status == "finite only"
    assert row.note == "Message: x is odd"


def test_equal_infinities_are_right_and_others_are_not():
    def infinite(sign):
        return lambda i: {"psnr": torch.full((2,), sign(i["x"].dtype) * math.inf), "z": i["x"]}

    assert compare(case(infinite(lambda dtype: 1))).status == "right"
    other = compare(case(infinite(lambda dtype: 1 if dtype == torch.float32 else -1)))
    assert other.status == "finite only"
    assert other.value_error == math.inf


def test_rounding_of_the_inputs_counts_only_without_same_numbers():
    def far(inputs):
        return {"z": (inputs["x"] + 0.1).sin()}

    tight = Tolerance(values=1e-9, gradients=1.0)
    assert compare(case(far, tolerance=tight)).status == "finite only"

    def exactly_representable(inputs):
        return {"z": inputs["x"].double() * 1.0}

    assert compare(case(exactly_representable, tolerance=tight)).status == "right"
    rounded = compare(case(exactly_representable, tolerance=tight, same_numbers=False))
    assert rounded.status == "finite only"
    assert 1e-9 < rounded.value_error < 1e-7


def test_tolerances_shrink_with_the_rounding_but_not_to_nothing():
    tolerance = Tolerance(1.0, 1e-4)
    assert tolerance.at(torch.float32) == tolerance
    assert tolerance.at(torch.float64).values == pytest.approx(2**-29)
    assert tolerance.at(torch.float64).gradients == pytest.approx(1e-9)


def test_the_table_has_a_row_for_each_case_and_backend(monkeypatch):
    plain = case(lambda i: {"z": i["x"]})
    drawn = next(c for c in all_cases() if c.name == "an image of 1 x 1")
    monkeypatch.setattr(module, "all_cases", lambda: (plain, drawn))
    rows = list(compare_all("cpu"))
    assert [row.backend for row in rows] == ["-", *drawn.backends()]
    assert all(row.status == "right" for row in rows)
