"""Means and spreads in closed form."""

from __future__ import annotations

import pytest
from report_folders import table

from gsgan.report.spec import written
from gsgan.report.table import mean_cell
from gsgan.utils.errors import ConfigError


def seeds(**values):
    """A cell's scores by seed."""
    return {seed: (value, None) for seed, value in values.items()}


def test_the_spread_is_the_sample_standard_deviation():
    found = mean_cell("psnr", seeds(a=1.0, b=2.0, c=4.0)).numbers
    assert found["mean"] == pytest.approx(7 / 3)
    assert found["spread"] == pytest.approx((7 / 3) ** 0.5)  # divided by n - 1
    assert found["n"] == 3


def test_one_value_has_no_spread_and_none_no_mean():
    assert mean_cell("psnr", seeds(a=3.0)).numbers["spread"] is None
    assert "mean" not in mean_cell("psnr", seeds(a=None)).numbers


@pytest.mark.parametrize(
    ("value", "text"), [(1.006, "1.01"), (-1.5, "−1.50"), (-0.001, "0.00"), (2.0, "2.00")]
)
def test_signs_and_digits(value, text):
    assert written("psnr", value) == text


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("metrics", [], "metrics must be a list of at least one"),
        ("metrics", ["fid"], "metrics must be one of psnr, .*got 'fid'"),
        ("splits", "novel_pose", "splits must be one of train, novel_view, novel_pose"),
        ("variants", ["floor"], "variants must be one of full, splat, got 'floor'"),
        ("rows", [{"run": "full", "variant": "floor"}], "variants must be one of"),
    ],
)
def test_a_wrong_value_is_refused_by_key(key, value, message):
    with pytest.raises(ConfigError, match=f"table.{message}"):
        table(**{key: value})
