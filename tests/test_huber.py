"""Huber's regression against a minimiser of its loss, and what outliers do to it."""

import numpy as np
import pytest
from scipy import optimize

from rotorwatch.stats import huber


def table(seed=0, n=400):
    rng = np.random.default_rng(seed)
    X = np.column_stack([np.ones(n), rng.standard_normal(n), 1e-4 * rng.standard_normal(n)])
    return X, X @ [1.0, -2.0, 3e4] + 0.1 * rng.standard_t(2.0, n)


def test_it_minimises_hubers_loss():
    X, y = table()
    fit = huber.regression(X, y, rounds=60)
    bound = huber.BOUND * fit.scale

    def loss(theta):
        r = np.abs(y - X @ (theta * [1.0, 1.0, 1e4]))
        return np.where(r < bound, 0.5 * r * r, bound * (r - 0.5 * bound)).sum()

    found = optimize.minimize(loss, [0.0, 0.0, 0.0], method="BFGS", options={"gtol": 1e-8}).x * [1.0, 1.0, 1e4]
    np.testing.assert_allclose(fit.theta, found, rtol=1e-5)
    np.testing.assert_allclose(fit.residual, y - X @ fit.theta, atol=1e-12)


def test_outliers_move_it_little():
    X, y = table()
    y[::20] += 50.0
    assert np.abs(huber.regression(X, y).theta - [1.0, -2.0, 3e4]).max() < 300.0
    assert np.abs(np.linalg.lstsq(X, y, rcond=None)[0] - [1.0, -2.0, 3e4]).max() > 600.0


def test_columns_that_say_nothing_are_no_error():
    X, y = table()
    X[:, 2] = 0.0
    assert huber.regression(X, y).theta[2] == 0.0
    X[:, 2] = X[:, 1]
    one, other = huber.regression(X, y).theta[1:]
    assert one + other == pytest.approx(huber.regression(X[:, :2], y).theta[1], abs=1e-6)


def test_a_mean_stays_where_most_are():
    rng = np.random.default_rng(2)
    assert np.abs(huber.mean(np.concatenate([rng.standard_normal((95, 2)), np.full((5, 2), 100.0)]))).max() < 0.5
    rest = np.array([-3.0, -1.0, 0.0, 1.0, 30.0])
    weight, scale = huber.weights(rest, 0.0)
    assert scale == pytest.approx(1.4826)
    np.testing.assert_allclose(weight * np.maximum(np.abs(rest), huber.BOUND * scale), huber.BOUND * scale)
