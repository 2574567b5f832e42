"""Means, spreads and paired differences in closed form."""

from __future__ import annotations

import pandas as pd
import pytest
from report_folders import table

from gsgan.report.scores import difference, mean_cell
from gsgan.report.spec import written
from gsgan.utils.errors import ConfigError


def seeds(**values):
    """A cell's scores by seed."""
    return pd.DataFrame({"seed": list(values), "value": list(values.values()), "note": None})


def test_the_spread_is_the_sample_standard_deviation():
    found = mean_cell("psnr", seeds(a=1.0, b=2.0, c=4.0)).numbers
    assert found["mean"] == pytest.approx(7 / 3)
    assert found["spread"] == pytest.approx((7 / 3) ** 0.5)  # divided by n - 1
    assert found["n"] == 3


def test_one_value_has_no_spread_and_none_no_mean():
    assert mean_cell("psnr", seeds(a=3.0)).numbers["spread"] is None
    assert "mean" not in mean_cell("psnr", seeds(a=float("nan"))).numbers


def test_differences_pair_only_the_seeds_that_both_have():
    ours, theirs = seeds(a=2.0, b=3.0, c=1.0, x=100.0), seeds(a=1.0, b=1.0, c=1.5, y=-100.0)
    found = difference("psnr", ours, theirs).numbers
    assert (found["n"], found["agreeing"]) == (3, 2)  # +1, +2, -0.5
    assert found["mean"] == pytest.approx(2.5 / 3)
    assert found["spread"] == pytest.approx((19 / 12) ** 0.5)
    assert found["seeds"] == {"a": 1.0, "b": 2.0, "c": -0.5}
    assert difference("psnr", seeds(a=1.0), seeds(b=1.0)).numbers == {"n": 0}


def test_equal_runs_differ_by_zero_without_a_sign():
    found = difference("psnr", seeds(a=1.0, b=2.0), seeds(a=1.0, b=2.0))
    assert (found.numbers["mean"], found.numbers["agreeing"]) == (0.0, 2)
    assert found.text.startswith("0.00")


@pytest.mark.parametrize(
    ("value", "signed", "text"),
    [(1.006, True, "+1.01"), (-1.5, True, "−1.50"), (-0.001, True, "0.00"), (2.0, False, "2.00")],
)
def test_signs_and_digits(value, signed, text):
    assert written("psnr", value, signed=signed) == text


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("apart", "maybe", "apart has maybe; known: False, True"),
        ("metrics", [], "metrics must be a list of at least one"),
        ("metrics", ["fid"], "metrics has fid; known: psnr"),
        ("splits", "novel_pose", "splits must be a list"),
        ("variants", ["floor"], "variants has floor; known: full, splat"),
        ("subjects", 377, "subjects must be a list"),
        ("rows", [3], "rows must be like"),
        ("rows", [{"model": "full"}], "rows must be like"),
        ("rows", [{"run": "full", "variant": "floor"}], "variants has floor"),
    ],
)
def test_a_wrong_value_is_refused_by_key(key, value, message):
    with pytest.raises(ConfigError, match=f"table.{message}"):
        table(**{key: value})
