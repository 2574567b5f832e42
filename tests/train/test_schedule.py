"""Schedules are pure maps from the iteration to a value."""

import math

import pytest

from gsgan.train.schedule import (
    SEGMENTATION,
    STEP_ONE,
    STEP_TWO,
    Rate,
    Schedule,
)
from gsgan.utils.errors import ConfigError


def make_schedule(*lengths, **more):
    plain = {
        "discriminator_start": 0,
        "epoch": 250,
        "stretch": 1.0,
        "degree_every": 0,
        "coarse": 0,
    }
    return Schedule(*lengths, **plain | more)


def make_rate(**more):
    plain = {"hold": 0.5, "final": 0.0, "warmup": 0, "shape": "cosine"}
    return Rate(**plain | more)


def test_phases_follow_each_other():
    s = make_schedule(
        segmentation=2, step_one=3, step_two=4, discriminator_start=1, epoch=4
    )
    assert [s.phase(i) for i in range(9)] == [SEGMENTATION] * 2 + [
        STEP_ONE
    ] * 3 + [STEP_TWO] * 4
    assert s.total == 9
    assert [s.adversarial(i) for i in range(9)] == [False] * 6 + [True] * 3
    assert s.bounds(STEP_TWO) == (5, 9)
    assert s.adversarial_span == (6, 9)
    late = make_schedule(
        segmentation=2, step_one=3, step_two=4, discriminator_start=9
    )
    assert late.adversarial_span == (9, 9)
    assert not any(late.adversarial(i) for i in range(9))


@pytest.mark.parametrize(
    "wrong",
    [
        {"segmentation": -1},
        {"epoch": 0},
        {"segmentation": 0, "step_one": 0, "step_two": 0},
    ],
)
def test_impossible_schedules_are_refused(wrong):
    with pytest.raises(ConfigError, match="schedule"):
        make_schedule(
            **({"segmentation": 1, "step_one": 1, "step_two": 1} | wrong)
        )


def test_rate_holds_then_descends_to_its_end():
    rate = make_rate(peak=2.0, hold=0.5, final=0.1)
    assert rate.at(0, 0, 100) == rate.at(50, 0, 100) == 2.0
    assert math.isclose(
        rate.at(75, 0, 100), 2.0 * (0.1 + 0.9 * 0.5), rel_tol=1e-9
    )
    assert math.isclose(rate.at(100, 0, 100), 0.2, rel_tol=1e-9)
    values = [rate.at(i, 0, 100) for i in range(101)]
    assert values == sorted(values, reverse=True)


@pytest.mark.parametrize(
    ("shape", "half"), [("linear", 0.505), ("exponential", 0.1)]
)
def test_rate_shapes(shape, half):
    rate = make_rate(peak=1.0, hold=0.0, final=0.01, shape=shape)
    assert math.isclose(rate.at(50, 0, 100), half, rel_tol=1e-9)
    assert math.isclose(rate.at(100, 0, 100), 0.01, rel_tol=1e-9)


@pytest.mark.parametrize("wrong", [{"shape": "step"}, {"hold": 1.1}])
def test_impossible_rates_are_refused(wrong):
    with pytest.raises(ConfigError, match="rate"):
        make_rate(**({"peak": 1.0} | wrong))


def test_rate_warms_up():
    rate = make_rate(peak=1.0, hold=1.0, warmup=3)
    assert [rate.at(i, 10, 20) for i in range(10, 15)] == [
        0.25,
        0.5,
        0.75,
        1.0,
        1.0,
    ]


def test_the_degree_is_raised_by_the_schedule():
    schedule = make_schedule(10, 30, 30, degree_every=20)
    assert [schedule.degree(s, 3) for s in (0, 9, 29, 30, 49, 50, 69)] == [
        0,
        0,
        0,
        1,
        1,
        2,
        2,
    ]
    assert schedule.degree(69, 1) == 1
    assert make_schedule(10, 30, 30).degree(0, 3) == 3  # 0: all at once
    with pytest.raises(ConfigError, match="degree_every"):
        make_schedule(1, 1, 1, degree_every=-1)


def test_f_is_supersampled_after_the_coarse_iterations_of_step_one():
    schedule = make_schedule(
        segmentation=10, step_one=30, step_two=30, coarse=20, stretch=0.5
    )
    fitted = schedule.fit_parts(segmentation=True, splats=True, generator=True)
    assert [fitted.fine(step) for step in (9, 10, 19, 20, 25, 39)] == [
        True,
        False,
        False,
        *[True] * 3,
    ]
