"""Distribution functions and small exact problems, against SciPy's."""

import numpy as np
import pytest
from scipy import optimize, special, stats

from rotorwatch.stats import nonnegative, tails


@pytest.mark.parametrize("dof", [1.0, 2.5, 14.0, 300.0])
def test_student(dof):
    x = np.concatenate([-np.geomspace(1e-6, 60.0, 25), [0.0], np.geomspace(1e-6, 60.0, 25)])
    np.testing.assert_allclose([tails.student_cdf(v, dof) for v in x], stats.t.cdf(x, dof), rtol=1e-10, atol=1e-300)


@pytest.mark.parametrize("dof", [1, 2, 3, 4, 13, 14, 38])
def test_student_of_many_is_that_of_each(dof):
    x = np.linspace(-50.0, 50.0, 41)
    np.testing.assert_allclose(tails.student_shares(x, dof), [tails.student_cdf(v, dof) for v in x], rtol=0, atol=1e-14)


@pytest.mark.parametrize("dof", [1.0, 6.0, 40.0])
@pytest.mark.parametrize("share", [0.001, 0.4, 0.975])
def test_student_quantile(share, dof):
    assert tails.student_quantile(share, dof) == pytest.approx(stats.t.ppf(share, dof), rel=1e-9)


@pytest.mark.parametrize("above, below", [(1, 1.0), (4, 3.5), (8, 40.0), (3, 2000.0)])
def test_f(above, below):
    x = np.concatenate([[0.0], np.geomspace(1e-6, 1e4, 30)])
    np.testing.assert_allclose([tails.f_tail(v, above, below) for v in x], stats.f.sf(x, above, below), rtol=1e-9, atol=1e-290)


def test_normal():
    x = np.linspace(-30.0, 10.0, 81)
    np.testing.assert_allclose(tails.normal_cdf(x), special.ndtr(x), rtol=1e-11)
    assert isinstance(float(tails.normal_cdf(0.3)), float)
    far = np.concatenate([-np.geomspace(1e-3, 1e4, 60), np.geomspace(1e-3, 30.0, 20)])
    np.testing.assert_allclose(tails.log_normal_cdf(far), special.log_ndtr(far), rtol=1e-11, atol=1e-300)


@pytest.mark.parametrize("low", [-40.0, -3.0, 0.0, 2.0, 25.0])
@pytest.mark.parametrize("share", [0.025, 0.5, 0.975])
def test_quantiles_above_a_limit(low, share):
    assert tails.normal_quantile(share, low) == pytest.approx(float(stats.truncnorm.ppf(share, low, np.inf)), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("columns", [1, 2, 3, 4, 6])
def test_least_squares_that_are_not_negative(columns):
    rng = np.random.default_rng(columns)
    for _ in range(200):
        A, b = rng.normal(size=(4, columns)), rng.normal(size=4)
        x, left = nonnegative.least_squares(A, b)
        slope = A.T @ (A @ x - b)
        assert left == pytest.approx(np.linalg.norm(A @ x - b), abs=1e-12)
        # Karush, Kuhn and Tucker: necessary, and of a convex problem sufficient.
        assert (x >= 0).all() and slope.min() > -1e-9 and np.abs(x * slope).max() < 1e-9 * max(1.0, x.max())
        other, _ = optimize.nnls(A, b)
        assert left <= np.linalg.norm(A @ other - b) + 1e-9  # SciPy 1.15 does not always find the best


def test_nothing_asked_nothing_given():
    x, left = nonnegative.least_squares(np.eye(3), np.zeros(3))
    assert (x == 0).all() and left == 0.0


@pytest.mark.parametrize("n", [1, 3, 6, 8])
def test_best_order(n):
    worth = np.random.default_rng(n).normal(size=(n, n))
    rows, columns = optimize.linear_sum_assignment(-worth)
    assert nonnegative.best_total(worth) == pytest.approx(worth[rows, columns].sum())
