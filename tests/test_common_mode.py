"""The thrust that all rotors share: what is a change, and what is a landing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from rotorwatch.answer.common_mode import BLOCKS, thrust_shift
from rotorwatch.stats.tails import student_quantile


def test_the_quantile_is_students():
    assert pytest.approx(stats.t.ppf(0.975, 2 * BLOCKS - 2), abs=5e-4) == student_quantile(0.975, 2 * BLOCKS - 2)


@given(st.floats(-2.0, 2.0), st.integers(0, 1000))
def test_a_change_is_measured_with_an_interval_of_students_test(change, seed):
    rng = np.random.default_rng(seed)
    collective = 0.05 * rng.standard_normal(900) + np.repeat([0.0, change / 2, change], 300)
    found = thrust_shift(collective)
    first, last = ([np.median(b) for b in np.array_split(part, BLOCKS)] for part in (collective[:300], collective[-300:]))
    other = stats.ttest_ind(last, first).confidence_interval(0.95)
    assert found["interval"] == pytest.approx([other.low, other.high], abs=1e-3)
    assert found["thrust_shift"] == pytest.approx(change, abs=0.05)


def test_intervals_hold_as_often_as_they_say():
    rng = np.random.default_rng(1)
    ends = np.array([thrust_shift(rng.standard_normal(300))["interval"] for _ in range(2000)])
    assert np.mean((ends[:, 0] < 0) & (ends[:, 1] > 0)) == pytest.approx(0.95, abs=0.015)


def test_a_landing_is_no_change():
    """The ground carries the vehicle in the last seconds."""
    collective = 0.02 * np.random.default_rng(2).standard_normal(600)
    collective[-30:] -= 2.0
    low, high = thrust_shift(collective)["interval"]
    assert low < 0.0 < high


def test_a_few_ticks_say_nothing():
    assert thrust_shift(np.zeros(3 * BLOCKS)) == {}
