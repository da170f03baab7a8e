"""Bounds on loss error and detection delay: closed forms, the dense Gaussian likelihood, and CUSUMs that are really run."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.engine.bindings import program
from rotorwatch.errors import ConfigError
from rotorwatch_lab.experiments import limits
from rotorwatch_lab.experiments.limits import Rows


def information(rows, P0, valid, onset):
    return np.asarray(load_jax().jit(lambda r, v: limits.information(lambda row: row, r, P0, v, onset))(rows, valid))


def level(T, sigma, spread, onset, q=0.0):
    """One state, a level of unknown height that walks by q; theta is added to its measurements."""
    one = np.ones((T, 1))
    rows = Rows(one, 0 * one, one[:, None], one, q * one[:, :, None], sigma**2 * one)
    return information(rows, np.array([[spread**2]]), np.ones((T, 1), bool), onset)


def drawn(seed, T=12, n=3, m=2):
    """Random time-varying matrices and an onset."""
    rng = np.random.default_rng(seed)
    L = rng.normal(size=(T, n, n))
    return Rows(
        0.5 * rng.normal(size=(T, n, n)), rng.normal(size=(T, n)), rng.normal(size=(T, m, n)), rng.normal(size=(T, m)),
        0.1 * L @ L.transpose(0, 2, 1), rng.uniform(0.1, 1.0, size=(T, m)),
    ), np.eye(n) * 2.0, rng.random((T, m)) < 0.8, int(rng.integers(1, T - 2))  # fmt: skip


def dense(rows, P0, valid, onset):
    """The same information from the joint distribution of all measurements: m' Sigma^-1 m."""
    T, n = rows.G.shape
    mean, x = [], np.zeros(n)
    spread, blocks = P0, []  # covariance of the state with itself, and what state k is made of
    factors = [(np.eye(n), P0)]
    for k in range(T):
        A = rows.A[k]
        factors = [(A @ F, V) for F, V in factors] + [(np.eye(n), rows.Q[k])]
        begun = k >= onset
        x = A @ x + begun * rows.G[k]
        mean.append(rows.C[k] @ x + begun * rows.H[k])
        blocks.append([(rows.C[k] @ F, V) for F, V in factors])
        spread = A @ spread @ A.T + rows.Q[k]
    m = rows.H.shape[1]
    Sigma = np.zeros((T * m, T * m))
    for i in range(T):
        for j in range(i + 1):
            both = sum(a @ V @ b.T for (a, V), (b, _) in zip(blocks[i], blocks[j]))  # the sources they share
            Sigma[i * m : i * m + m, j * m : j * m + m] = both
            Sigma[j * m : j * m + m, i * m : i * m + m] = both.T
    Sigma += np.diag(rows.R.reshape(-1))
    ok = valid.reshape(-1)
    mean = np.array(mean).reshape(-1)[ok]
    return mean @ np.linalg.solve(Sigma[np.ix_(ok, ok)], mean)


def test_a_known_level_in_white_noise():
    found = level(50, 0.3, 0.0, 10)
    assert np.allclose(found[:10], 0.0)
    np.testing.assert_allclose(found[10:], np.arange(1, 41) / 0.09, rtol=1e-12)
    assert limits.loss_sd(found[-1]) == pytest.approx(0.3 / np.sqrt(40))


def test_an_unknown_level_costs_what_it_takes_to_learn():
    """Difference of two means: variance sigma^2 (1 / before + 1 / after)."""
    found = level(60, 0.3, 1e5, 20)
    expected = 1.0 / (0.09 * (1 / 20 + 1 / np.arange(1, 41)))
    np.testing.assert_allclose(found[20:], expected, rtol=1e-6)


def test_a_walking_level_stops_telling():
    """Steady state of the scalar Riccati equation; a jump of a random walk is seen only as long as it has not walked away."""
    sigma, q = 0.3, 0.01
    P = 0.5 * (q + np.sqrt(q * q + 4 * q * sigma**2))
    S, K = P + sigma**2, P / (P + sigma**2)
    expected = np.cumsum((1 - K) ** (2 * np.arange(200))) / S
    np.testing.assert_allclose(level(500, sigma, 0.2, 300, q)[300:], expected, rtol=1e-9)


@given(seed=st.integers(0, 2**31 - 1))
@settings(max_examples=15, deadline=None)
def test_equals_the_dense_likelihood(seed):
    rows, P0, valid, onset = drawn(seed)
    assert information(rows, P0, valid, onset)[-1] == pytest.approx(dense(rows, P0, valid, onset), rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("planted", ["G", "H", "onset", "Q"])
def test_the_dense_likelihood_sees_planted_errors(planted):
    rows, P0, valid, onset = drawn(5)
    wrong = rows._replace(**{planted: 1.1 * getattr(rows, planted)}) if planted != "onset" else rows
    found = information(wrong, P0, valid, onset + (planted == "onset"))[-1]
    assert abs(found - dense(rows, P0, valid, onset)) > 1e-3


def test_what_is_not_measured_does_not_tell():
    rows, P0, valid, onset = drawn(3)
    assert np.all(information(rows, P0, 0 * valid.astype(int) > 0, onset) == 0.0)


def run_cusum(drift, mean, h, rng, runs=400, most=200_000):
    """Mean steps until a CUSUM of log likelihood ratios for a shift by `drift` in unit noise passes h."""
    s, alive, steps = np.zeros(runs), np.ones(runs, bool), np.zeros(runs)
    for k in range(1, most):
        s = np.maximum(s + drift * (mean + rng.standard_normal(runs) - 0.5 * drift), 0.0)
        over = alive & (s >= h)
        steps[over], alive = k, alive & ~over
        if not alive.any():
            return steps.mean()
    raise AssertionError("never")


def test_cusums_that_are_run():
    """Mean times to false alarms and to detections of real CUSUMs; 1.166 sigma for the steps' size (Siegmund 1985)."""
    drift, period = 0.1, 3000.0
    rate = 0.5 * drift**2
    h, needed = limits.cusum(rate, period)
    rng = np.random.default_rng(4)
    assert run_cusum(drift, 0.0, h - 1.166 * drift, rng) == pytest.approx(period, rel=0.15)
    assert run_cusum(drift, drift, h - 1.166 * drift, rng) == pytest.approx(needed / rate, rel=0.08)


@given(wanted=st.floats(1e-6, 1e12))
@settings(max_examples=trials(40), deadline=None)
def test_the_threshold_solves_its_equation(wanted):
    h, needed = limits.cusum(1.0, wanted)
    assert np.expm1(h) - h == pytest.approx(wanted, rel=1e-6)
    assert needed == pytest.approx(h - 1 + np.exp(-h), abs=1e-9)


def test_delays_follow_the_information():
    """A steady flow of information: the delay is what is needed over the rate; a larger loss or more false alarms are quicker."""
    time = np.arange(1, 4001) * 0.01
    flow = np.maximum(time - 10.0, 0.0) * 5000.0
    expected = limits.cusum(0.5 * 0.1**2 * 5000.0, 3600.0)[1] / (0.5 * 0.1**2 * 5000.0)
    assert limits.delay(time, flow, 0.1, 10.0, 3600.0) == pytest.approx(expected, abs=0.011)
    assert limits.delay(time, flow, 0.2, 10.0, 3600.0) < limits.delay(time, flow, 0.1, 10.0, 3600.0)
    assert limits.delay(time, flow, 0.1, 10.0, 36.0) < limits.delay(time, flow, 0.1, 10.0, 3600.0)
    assert limits.delay(time, 0.0 * flow, 0.1, 10.0, 3600.0) == np.inf
    assert limits.delay(time, flow, 0.001, 10.0, 3600.0) == np.inf


def test_numbers_that_make_no_sense():
    with pytest.raises(ConfigError, match="above zero"):
        limits.cusum(1.0, 0.0)
    with pytest.raises(ConfigError, match="above zero"):
        limits.cusum(-1.0, 10.0)


def test_on_ticks_in_white_noise():
    """Hover with white wrench noise only: no better than the difference of two means on the axes that the rotor works on, and not
    much worse: from differences up to 64 ticks the noise model cannot rule out a slow drift."""
    n, T, onset, sd = 4, 600, 300, 0.05
    B = np.array([[-1.0, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1]])
    rng = np.random.default_rng(2)
    u = np.zeros((T, n + 13))
    u[:, :n], u[:, n + 3], u[:, n + 9] = 1.0, n, 2.5
    theta = np.zeros((T, n))
    theta[onset:, 1] = 0.3
    y = np.array([0.0, 0.0, 0.0, float(n)]) + (u[:, :n] * theta) @ B.T + sd * rng.standard_normal((T, 4))
    ok = np.ones((T, 4), bool)
    found = limits.on_ticks(B, u, y, ok, ok[:, 0], theta, 1, onset, 0.1)
    best = sd / 2.0 * np.sqrt(1 / onset + 1 / (T - onset))  # four axes with a lever of 1
    assert 0.8 * best < limits.loss_sd(found.information[-1]) < 6.0 * best
    assert np.sqrt(found.variances[0]) == pytest.approx(sd, rel=0.15)
    assert np.all(found.information[:onset] == 0.0)
    many = limits.on_ticks(B, *(np.stack([a] * 2) for a in (u, y, ok, ok[:, 0], theta)), [1, 1], [onset] * 2, 0.1, batch=True)
    np.testing.assert_allclose(many.information[1], found.information, rtol=1e-9)


def test_the_drag_of_unequal_rotors_is_no_noise_on_ticks():
    """Commands that change from tick to tick in wind: what the rotors' drag yaws is known, and of a loss taken out of the noise."""
    n, T, onset, sd = 4, 600, 300, 0.05
    B = np.array([[-1.0, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1], [1, 1, 1, 1]])
    rng = np.random.default_rng(3)
    u = np.zeros((T, n + 13))
    u[:, n + 9] = 2.5
    u[:, :n], u[:, n + 3] = rng.uniform(0.4, 1.6, (T, n)), n
    u[:, n + 7 : n + 9] = 4.0, -3.0
    theta = np.zeros((T, n))
    theta[onset:, 1] = 0.3
    _, drag = limits.balance(u, program.steps(0.1, B).plant)
    y = np.array([0.0, 0.0, 0.0, float(n)]) + (u[:, :n] * theta) @ B.T + sd * rng.standard_normal((T, 4))
    y[:, 2] -= (drag * (1.0 - theta)).sum(axis=1)
    ok = np.ones((T, 4), bool)
    found = limits.on_ticks(B, u, y, ok, ok[:, 0], theta, 1, onset, 0.1)
    assert np.sqrt(found.variances[0]) == pytest.approx(sd, rel=0.15)
