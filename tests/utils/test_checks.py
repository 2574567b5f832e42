"""Checks of config values: the value comes back, or one sentence names the key."""

import pytest

from gsgan.utils.checks import at_least, between, integer, one_of, positive
from gsgan.utils.errors import ConfigError


def test_good_values_come_back():
    assert at_least("a", 1.5, 1.5) == 1.5
    assert positive("a", 0.1) == 0.1
    assert between("a", 1, 0, 1) == 1
    assert integer("a", 3, 3) == 3
    assert one_of("a", "x", ("x", "y")) == "x"


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (
            lambda: at_least("data.seed", -1, 0),
            "data.seed must be a number of at least 0, got -1",
        ),
        (
            lambda: at_least("a", True, 0),
            "a must be a number of at least 0, got True",
        ),
        (lambda: at_least("a", float("nan"), 0), "got nan"),
        (lambda: at_least("a", "1", 0), "got '1'"),
        (lambda: positive("a", 0), "a must be a number above 0, got 0"),
        (
            lambda: between("a", 2, 0, 1),
            "a must be a number from 0 to 1, got 2",
        ),
        (
            lambda: integer("a", 1.5, 1),
            "a must be a whole number of at least 1, got 1.5",
        ),
        (
            lambda: one_of("a", "z", ("x", "y")),
            "a must be one of x, y, got 'z'",
        ),
        (
            lambda: one_of("a", 1, (True, False)),
            "a must be one of True, False, got 1",
        ),
    ],
)
def test_other_values_are_refused(check, message):
    with pytest.raises(ConfigError) as caught:
        check()
    assert message in str(caught.value)
