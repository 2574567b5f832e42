"""Shares that are not known are not printed as numbers."""

from gsgan.check.calibration import percent


def test_an_unknown_share_is_not_a_number_to_print():
    assert percent(float("nan")) == "n/a"
    assert percent(0.256) == "26%"
    assert percent(0.256, digits=1) == "25.6%"
