"""Means, spreads and paired differences in closed form."""

from __future__ import annotations

import pytest
from report_folders import table

from gsgan.report.cells import paired, summarise
from gsgan.report.spec import shown
from gsgan.utils.errors import ConfigError


def test_the_spread_is_the_sample_standard_deviation():
    found = summarise([1.0, 2.0, 4.0])
    assert found.mean == pytest.approx(7 / 3)
    assert found.spread == pytest.approx((7 / 3) ** 0.5)  # divided by n - 1
    assert found.n == 3


def test_one_value_has_no_spread_and_none_no_mean():
    assert summarise([3.0]).spread is None
    assert summarise([]) is None


def test_differences_pair_only_the_seeds_that_both_have():
    found = paired({0: 2.0, 1: 3.0, 2: 1.0, 7: 100.0}, {0: 1.0, 1: 1.0, 2: 1.5, 8: -100.0})
    assert (found.summary.n, found.agreeing) == (3, 2)  # +1, +2, -0.5
    assert found.summary.mean == pytest.approx(2.5 / 3)
    assert found.summary.spread == pytest.approx((19 / 12) ** 0.5)
    assert found.by_seed == {0: 1.0, 1: 2.0, 2: -0.5}
    assert paired({0: 1.0}, {1: 1.0}) is None


def test_equal_runs_differ_by_zero_without_a_sign():
    found = paired({0: 1.0, 1: 2.0}, {0: 1.0, 1: 2.0})
    assert (found.summary.mean, found.agreeing) == (0.0, 2)


@pytest.mark.parametrize(
    ("value", "signed", "text"),
    [(1.006, True, "+1.01"), (-1.5, True, "−1.50"), (-0.001, True, "0.00"), (2.0, False, "2.00")],
)
def test_signs_and_digits(value, signed, text):
    assert shown("psnr", value, signed=signed) == text


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("name", None, "name must be a text"),
        ("title", "", "title must be a text"),
        ("data", 3, "data must be a text"),
        ("apart", "maybe", "apart must be true or false"),
        ("metrics", [], "metrics must be a list of at least one"),
        ("metrics", [{"a": 1}], "metrics must be a list of names"),
        ("metrics", ["psnr", "psnr"], "metrics has psnr twice"),
        ("metrics", ["fid"], "fid; known: psnr"),
        ("splits", "novel_pose", "splits must be a list"),
        ("variants", ["floor"], "among full and splat"),
        ("subjects", 377, "subjects must be a list"),
        ("subjects", [], "subjects must be a list of at least one"),
        ("rows", 3, "rows must be a list"),
        ("rows", [3], "rows must be like"),
        ("rows", [{"model": "full"}], "rows must be like"),
        ("rows", [{"run": "full"}, {"run": "full"}], "twice"),
        ("rows", [{"run": "full", "label": 3}], "run and label must be texts"),
        ("rows", [{"run": "full", "variant": "floor"}], "variant must be full or splat"),
    ],
)
def test_a_table_that_cannot_be_is_refused_by_key(key, value, said):
    with pytest.raises(ConfigError, match=f"table.{said}|{said}"):
        table(**{key: value})
