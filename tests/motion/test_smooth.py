"""The One Euro filter: its delay and what it leaves of noise, and when it starts anew."""

import math

import numpy as np
import pytest

from gsgan.motion.smooth import OneEuro
from gsgan.utils.errors import ConfigError

FPS = 30
FRAMES = 900
TIMES = np.arange(FRAMES) / FPS
SETTLED = slice(60, None)


def swing(amplitude: float, hertz: float, noise: float) -> np.ndarray:
    """``[FRAMES, 1, 3]`` metres of one joint, which moves along the first axis."""
    p = np.random.default_rng(0).normal(scale=noise, size=(FRAMES, 1, 3))
    p[:, 0, 0] += amplitude * np.sin(2 * np.pi * hertz * TIMES)
    return p


def filtered(
    p: np.ndarray, times: np.ndarray = TIMES, **settings: float
) -> np.ndarray:
    smooth = OneEuro(**settings)
    return np.stack(
        [smooth(own, t) for own, t in zip(p, times.tolist(), strict=True)]
    )


def delay(p: np.ndarray, hertz: float) -> tuple[float, float]:
    """Milliseconds by which the sine in ``p [FRAMES, 1, 3]`` is late, and its amplitude."""
    phase = 2 * np.pi * hertz * TIMES
    waves = np.stack([np.sin(phase), np.cos(phase)], axis=1)
    (sine, cosine), *_ = np.linalg.lstsq(waves[SETTLED], p[SETTLED, 0, 0])
    late = -math.atan2(cosine, sine) / (2 * np.pi * hertz)
    return 1000 * late, math.hypot(sine, cosine)


def jitter(p: np.ndarray) -> float:
    """The change from frame to frame of a coordinate that does not move."""
    return float(np.diff(p[SETTLED, 0, 1]).std())


@pytest.mark.parametrize(
    ("amplitude", "hertz", "noise", "late", "size", "left"),
    [
        (0.3, 0.5, 0.005, 31, 1.01, 0.40),
        (0.3, 1.0, 0.005, 26, 1.01, 0.46),
        (0.05, 0.5, 0.003, 69, 0.97, 0.24),
    ],
)
def test_the_delay_and_the_noise_left_are_the_documented_ones(
    amplitude, hertz, noise, late, size, left
):
    p = swing(amplitude, hertz, noise)
    found = filtered(p)
    milliseconds, reached = delay(found, hertz)
    assert milliseconds == pytest.approx(late, abs=4)
    assert reached / amplitude == pytest.approx(size, abs=0.02)
    assert jitter(found) / jitter(p) == pytest.approx(left, abs=0.05)


@pytest.mark.parametrize(("noise", "left"), [(0.003, 0.20), (0.01, 0.24)])
def test_a_joint_at_rest_loses_most_of_its_noise(noise, left):
    p = swing(0, 1, noise)
    assert jitter(filtered(p)) / jitter(p) == pytest.approx(left, abs=0.03)


def test_a_lower_cutoff_is_smoother_and_later():
    p = swing(0.05, 0.5, 0.003)
    low = filtered(p, min_cutoff=0.5)
    high = filtered(p, min_cutoff=4)
    assert jitter(low) < 0.5 * jitter(high)
    assert delay(low, 0.5)[0] > 2 * delay(high, 0.5)[0]


def test_only_the_past_counts():
    p = swing(0.3, 0.5, 0.005)
    changed = p.copy()
    changed[500:] += 0.1
    np.testing.assert_array_equal(filtered(p)[:500], filtered(changed)[:500])


def test_the_delay_is_in_seconds_at_every_rate():
    slow = swing(0.3, 0.5, 0)[::2]
    found = filtered(slow, TIMES[::2])
    phase = np.pi * TIMES[::2]
    waves = np.stack([np.sin(phase), np.cos(phase)], axis=1)
    (sine, cosine), *_ = np.linalg.lstsq(waves[30:], found[30:, 0, 0])
    assert -1000 * math.atan2(cosine, sine) / np.pi == pytest.approx(31, abs=8)


def test_unknown_joints_stay_unknown_and_start_anew():
    p = swing(0.3, 0.5, 0.005)
    p = np.concatenate([p, p], axis=1)
    p[300:310, 1] = np.nan
    found = filtered(p)
    assert np.isnan(found[300:310, 1]).all()
    np.testing.assert_array_equal(found[310, 1], p[310, 1])
    assert np.isfinite(found[:, 0]).all()
    assert np.isfinite(found[310:, 1]).all()
    np.testing.assert_array_equal(found[:, 0], filtered(p[:, :1])[:, 0])


def test_a_jump_is_followed_at_once():
    p = swing(0, 1, 0.003)
    p[400:] += [1.0, 0, 0]
    found = filtered(p)
    np.testing.assert_array_equal(found[400], p[400])
    assert np.abs(found[401:, 0, 0] - 1).max() < 0.02
    # slower than a jump: on the way
    p[400:] -= [0.7, 0, 0]
    assert 0 < filtered(p)[400, 0, 0] < 0.28


def test_after_a_pause_all_joints_start_anew():
    p = swing(0, 1, 0.003)
    p[400:] += [0.2, 0, 0]
    times = TIMES.copy()
    times[400:] += 0.3
    np.testing.assert_array_equal(filtered(p, times)[400], p[400])
    times[400:] -= 0.2
    assert not np.array_equal(filtered(p, times)[400], p[400])


@pytest.mark.parametrize(
    "key", ["min_cutoff", "speed_cutoff", "max_speed", "max_pause"]
)
def test_settings_that_are_out_of_range_are_named(key):
    with pytest.raises(ConfigError, match=f"smooth.{key}"):
        OneEuro(**{key: 0})
