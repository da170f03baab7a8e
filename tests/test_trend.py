"""Slopes under correlated errors: their 95 % intervals hold the truth, whether errors wander, are correlated for a while, or not at all."""

import numpy as np
import pytest

from rotorwatch.answer import trend
from rotorwatch.errors import ConfigError

STEP, FLIGHTS = 5.0, 300


def walk(rng, N):
    return np.cumsum(rng.standard_normal(N))


def correlated(rng, N, rho=0.8):
    out = rng.standard_normal(N)
    out[0] /= np.sqrt(1.0 - rho**2)
    for k in range(1, N):
        out[k] += rho * out[k - 1]
    return out


def white(rng, N):
    return rng.standard_normal(N)


def both(rng, N):
    return walk(rng, N) + 2.0 * rng.standard_normal(N)


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("errors", [walk, correlated, white, both])
def test_intervals_hold_the_truth(errors):
    """Of 300 series, as often as promised but for chance (a standard deviation is 0.013) and what is not known of short walks."""
    rng, N = np.random.default_rng(7), 30
    time = STEP * np.arange(N)
    found = [trend.slope(time, errors(rng, N) + 3.0, STEP) for _ in range(FLIGHTS)]
    assert np.mean([s.low <= 0.0 <= s.high for s in found]) >= 0.9
    assert all(s.low < s.slope < s.high for s in found)


@pytest.mark.parametrize("errors", [walk, correlated])
def test_with_a_slope_all_moves_by_it(errors):
    """So that intervals hold a slope as often as they hold none."""
    rng, N = np.random.default_rng(8), 30
    time = STEP * np.arange(N)
    for _ in range(5):
        y = errors(rng, N)
        np.testing.assert_allclose(trend.slope(time, y + 0.3 * time, STEP), np.add(trend.slope(time, y, STEP), 0.3), atol=1e-7)


def test_least_squares_would_be_sure_of_slopes_that_are_none():
    """The reason for all this: on walks without a slope, the usual interval misses 0 more often than not."""
    rng, N, missed = np.random.default_rng(1), 30, 0
    time = STEP * np.arange(N)
    for _ in range(100):
        (b, _), cov = np.polyfit(time, walk(rng, N), 1, cov=True)
        missed += abs(b) > 1.96 * np.sqrt(cov[0, 0])
    assert missed > 50


def test_a_slope_that_stands_out_is_found_the_more_exactly_the_quieter_the_errors():
    rng, N = np.random.default_rng(3), 40
    time = STEP * np.arange(N)
    wide = {f: trend.slope(time, 0.5 * time + f(rng, N), STEP) for f in (walk, white)}
    assert all(s.low > 0.0 for s in wide.values())
    assert wide[white].sd < 0.8 * wide[walk].sd


def test_gaps_and_units():
    """Values that are missing are just not there; a scale of values or of time is a scale of the slope."""
    rng = np.random.default_rng(4)
    time = STEP * np.delete(np.arange(40), [5, 6, 7, 20])
    y = 0.1 * time + walk(rng, 40)[: time.size]
    a, b = trend.slope(time, y, STEP), trend.slope(time / 60.0, 2.0 * y + 5.0, STEP / 60.0)
    np.testing.assert_allclose(b, 120.0 * np.array(a), rtol=1e-6)
    assert a.low < 0.1 < a.high


def test_a_straight_line_without_errors():
    found = trend.slope(np.arange(20.0), 2.0 * np.arange(20.0), 1.0)
    np.testing.assert_allclose(found, 2.0, rtol=1e-6)


def test_too_few_values_are_refused():
    with pytest.raises(ConfigError, match="at least 16 values, not 15"):
        trend.slope(np.arange(15.0), np.zeros(15), 1.0)
