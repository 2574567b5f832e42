"""The comparison with float64: it finds what is wrong, and only that."""

import math
import warnings

import pytest
import torch
from torch import Tensor

from stability.cases.case import Case, Tolerance, compare


class Spoiled(torch.autograd.Function):
    """The identity, with a gradient multiplied by a number."""

    @staticmethod
    def forward(ctx, x: Tensor, factor: float) -> Tensor:
        ctx.factor = factor
        return x.clone()

    @staticmethod
    def backward(ctx, grad: Tensor):
        return grad * ctx.factor, None


def compared(run, **options):
    """The row of a case with inputs x and y."""
    x = torch.tensor([1.1, -2.3, 0.7], dtype=torch.float64)
    inputs = {"x": x, "y": x + 1, "n": torch.tensor([1, 2])}
    return compare(Case("a subject", "a case", inputs.copy, run, **options))


def spoiled(x: Tensor, factor: float) -> Tensor:
    """The identity, whose gradient is wrong in float32."""
    return Spoiled.apply(x, factor) if x.dtype == torch.float32 else x


def off(x: Tensor, factor: float) -> Tensor:
    """The identity, which is wrong in float32."""
    return factor * x if x.dtype == torch.float32 else x


def refusing(inputs):
    raise ValueError("x must be nicer")


def warning(inputs, factor=1.0):
    warnings.warn("x is odd", stacklevel=1)
    return {"z": off(inputs["x"], factor)}


@pytest.mark.parametrize(
    ("run", "status", "values", "gradients", "worst", "note"),
    [
        (lambda i: {"z": i["x"].exp() * i["y"]}, "right", 0, 0, None, ""),
        (
            lambda i: {"z": i["y"], "w": off(i["x"], 1.1)},
            "finite only",
            0.1,
            0.1,
            "x",
            "",
        ),
        (
            lambda i: {"z": i["x"] * spoiled(i["y"], 1.5)},
            "finite only",
            0,
            0.5,
            "y",
            "",
        ),
        (
            lambda i: {"z": spoiled(i["x"], math.nan)},
            "not finite",
            0,
            math.inf,
            "x",
            "",
        ),
        (
            lambda i: {"z": off(math.inf * i["x"], -1)},
            "finite only",
            math.inf,
            math.nan,
            "x",
            "",
        ),
        (
            refusing,
            "refused",
            math.nan,
            math.nan,
            "",
            "Message: x must be nicer",
        ),
        (warning, "warned", 0, 0, None, "Message: x is odd"),
        (
            lambda i: warning(i, 1.1),
            "finite only",
            0.1,
            0.1,
            "x",
            "Message: x is odd",
        ),
    ],
)
def test_status_errors_worst_input_and_message(
    run, status, values, gradients, worst, note
):
    row = compared(run)
    assert row.status == status
    assert row.value_error == pytest.approx(
        values, rel=1e-5, abs=1e-6, nan_ok=True
    )
    if not math.isnan(gradients):
        assert row.gradient_error == pytest.approx(
            gradients, rel=1e-5, abs=1e-6
        )
    assert worst is None or row.worst_input == worst
    assert row.note == note


def test_another_error_is_not_hidden():
    with pytest.raises(ZeroDivisionError):
        compared(lambda i: 1 / 0)


def test_a_gradient_where_there_is_none_is_infinitely_wrong_but_for_a_floor():
    def leaky(inputs):
        leak = 1e-9 if inputs["y"].dtype == torch.float32 else 0.0
        return {"z": inputs["x"] + leak * inputs["y"]}

    row = compared(leaky)
    assert (row.status, row.gradient_error, row.worst_input) == (
        "finite only",
        math.inf,
        "y",
    )
    assert compared(leaky, gradient_floor={"y": 1e-6}).status == "right"


def test_rounding_of_the_inputs_counts_only_without_same_numbers():
    def exact(inputs):
        return {"z": inputs["x"].double() * 1.0}

    tight = Tolerance(values=1e-9, gradients=1.0)
    assert compared(exact, tolerance=tight).status == "right"
    rounded = compared(exact, tolerance=tight, same_numbers=False)
    assert rounded.status == "finite only"
    assert 1e-9 < rounded.value_error < 1e-7
