"""The mathematics of the ESC consistency check: laws are found again, probabilities are probabilities and follow what is measured."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch.witnesses.esc import ratios

LOSSES = st.floats(0.05, 0.95)


def made(power=1.1, n=4, bins=200, noise=0.01, seed=0):
    """(y, x, known) of rotors that obey a law, with common changes and noise."""
    rng = np.random.default_rng(seed)
    x = np.log(0.4 + 0.1 * np.sin(np.arange(bins) / 5.0)[:, None] + 0.02 * rng.standard_normal((bins, n)))
    common = np.cumsum(0.002 * rng.standard_normal(bins))[:, None]
    y = np.linspace(8.0, 9.0, n) + power * x + common + noise * rng.standard_normal((bins, n))
    return y, x, np.ones((bins, n), bool)


@pytest.mark.parametrize("power", [0.8, 1.0, 1.4])
def test_a_law_is_found_again(power):
    y, x, known = made(power)
    law = ratios.learn(y, x, known, (1.0, 0.3))
    assert law.power == pytest.approx(power, abs=3.0 * law.power_sd) and law.known.all()
    assert np.diff(law.own) == pytest.approx(1.0 / 3.0, abs=0.02)
    # The median of three others adds its own noise.
    assert np.all((law.scatter > 0.007) & (law.scatter < 0.02))


def test_what_is_common_to_all_does_not_count_and_what_is_one_rotors_does():
    y, x, known = made()
    law = ratios.learn(y, x, known, (1.0, 0.3))
    y[100:] -= 0.2
    rest, _ = ratios.residual(law, y, x, known)
    assert np.abs(rest[100:].mean(axis=0) - rest[:100].mean(axis=0)).max() < 0.01
    y[100:, 2] -= 0.1
    rest, _ = ratios.residual(law, y, x, known)
    change = rest[100:].mean(axis=0) - rest[:100].mean(axis=0)
    assert change[2] == pytest.approx(-0.1, abs=0.01) and np.abs(np.delete(change, 2)).max() < 0.05


@given(S=st.floats(0.0, 1.3), D=st.floats(-2.0, 2.0) | st.none(), theta=LOSSES, sd=st.floats(0.001, 0.2), load=st.floats(0.1, 4.0))
@settings(max_examples=trials(200), deadline=None)
def test_probabilities_are_probabilities(S, D, theta, sd, load):
    share = ratios.causes(ratios.Measured((S, 0.02), None if D is None else (D, 0.05), load, 20), theta, sd)
    assert set(share) == set(ratios.PRIOR) and sum(share.values()) == pytest.approx(1.0)
    assert all(0.0 <= p <= 1.0 for p in share.values())


@given(theta=st.floats(0.15, 0.9))
@settings(max_examples=trials(60), deadline=None)
def test_each_cause_is_the_likeliest_where_it_predicts(theta):
    def best(S, D, load):
        share = ratios.causes(ratios.Measured((S, 0.01), (D, 0.04), load, 20), theta, 0.02)
        return max(share, key=lambda cause: share[cause])

    load = (1.0 - theta) ** -1.5
    assert best(1.0, -0.7 * theta * load, load) == ratios.PROPELLER
    assert best(1.0 - theta, 0.0, 1.0) == ratios.MOTOR
    assert best(1.0 - theta, 0.6, 1.0) == ratios.BEARING


@given(theta=LOSSES, low=st.floats(0.5, 1.0), step=st.floats(0.01, 0.3))
@settings(max_examples=trials(100), deadline=None)
def test_a_slower_rotor_speaks_against_the_propeller(theta, low, step):
    """The odds of propeller against motor rise with the speed, wherever it lies between what both predict."""

    def odds(S):
        share = ratios.causes(ratios.Measured((S, 0.05), None, 1.0, 20), theta, 0.02)
        return np.log(share[ratios.PROPELLER] + 1e-300) - np.log(share[ratios.MOTOR] + 1e-300)

    S = 1.0 - theta * low
    assert odds(min(S + step * theta * low, 1.0)) >= odds(S) - 1e-9


@given(theta=LOSSES, S=st.floats(0.3, 1.1))
@settings(max_examples=trials(100), deadline=None)
def test_the_parts_make_the_whole(theta, S):
    split = ratios.parts(ratios.Measured((S, 0.01), None, 1.0, 20), theta, 0.02)
    for value, low, high in split.values():
        assert 0.0 <= low <= value <= high <= 1.0
    if S <= 1.0 and 1.0 - theta <= S:
        assert (1.0 - split["speed"][0]) * (1.0 - split["propeller"][0]) == pytest.approx(1.0 - theta)


def test_noise_makes_it_unsure():
    sure, unsure = (ratios.causes(ratios.Measured((0.9, sd), (0.0, sd), 1.0, 20), 0.1, 0.02) for sd in (0.01, 0.3))
    assert sure[ratios.MOTOR] > 0.85 > 0.6 > max(unsure.values())


def test_memory_widens_a_mean():
    assert ratios.mean_variance(0.1, 0.0, 10) == pytest.approx(0.001)
    assert ratios.mean_variance(0.1, 0.5, 10) == pytest.approx(0.003)
