"""Two publishers in one topic instance are distinguished; a single one never is."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch.logs import px4_outputs

STEP = 10.0  # us


def outputs(n=400, seed=0, noise=3.0):
    """Outputs of a flight: a slow swing and some noise, in us."""
    rng = np.random.default_rng(seed)
    time = np.arange(n)[:, None] * 0.02
    return 1500.0 + 60.0 * np.sin(time + np.arange(4)) + noise * rng.standard_normal((n, 4))


def interleaved(one, other, every):
    """Samples of `other` put between those of `one`, one after each `every`; and which are whose."""
    rows, owner = [], []
    for k, row in enumerate(one):
        rows.append(row)
        owner.append(0)
        if k % every == every - 1 and k // every < len(other):
            rows.append(other[k // every])
            owner.append(1)
    return np.array(rows), np.array(owner)


@pytest.mark.parametrize("every", [1, 3, 7])
def test_a_publisher_that_stands_still_is_left_out(every):
    flown = outputs()
    values, owner = interleaved(flown, np.full((400, 4), [1500.0, 1900.0, 1500.0, 1500.0]), every)
    found = px4_outputs.tracks(values, STEP)
    assert len(found) == 2
    keep = px4_outputs.flown(values, found)
    assert keep is not None and np.mean(owner[keep] == 0) > 0.98 and keep.size > 0.98 * 400


def test_two_that_both_move_leave_a_doubt():
    values, _ = interleaved(outputs(), outputs(seed=1) + np.array([400.0, -300.0, 0.0, 0.0]), 1)
    found = px4_outputs.tracks(values, STEP)
    assert len(found) == 2 and px4_outputs.flown(values, found) is None


@settings(max_examples=trials(30), deadline=None)
@given(seed=st.integers(0, 1000), noise=st.floats(0.0, 120.0), cut=st.integers(50, 350), to=st.floats(900.0, 2000.0))
def test_a_single_publisher_is_never_split(seed, noise, cut, to):
    """Noisy outputs that jump from sample to sample, and one that is switched off or held in flight."""
    values = outputs(seed=seed, noise=noise)
    values[cut:, 1] = to
    assert len(px4_outputs.tracks(values, STEP)) == 1
