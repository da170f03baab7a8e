"""The unscented transform against the textbook's weighted sums, and the parts of filters made of it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conftest import trials
from rotorwatch.base.backend import jax as load_jax
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import unscented

jax = load_jax()
N, M = 4, 3
PROPERTY = settings(deadline=None, max_examples=trials(30))


def gaussian(seed):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((N, N))
    return rng.standard_normal(N), root @ root.T + 0.01 * np.eye(N), rng.standard_normal((M, N))


def curved(x):
    return jax.numpy.stack([x[0] * x[1], x[2] ** 2 + x[3], jax.numpy.sin(x[0])])


def textbook(x, P, alpha, beta, kappa):
    """Mean, covariance and cross-covariance of `curved` by Julier's weighted sums."""
    n = len(x)
    size = alpha**2 * (n + kappa)
    L = np.linalg.cholesky(P)
    chi = np.vstack([x, x + np.sqrt(size) * L.T, x - np.sqrt(size) * L.T])
    w_m = np.full(2 * n + 1, 0.5 / size)
    w_m[0] = 1 - n / size
    w_c = w_m.copy()
    w_c[0] += 1 - alpha**2 + beta
    y = np.stack([np.stack([c[0] * c[1], c[2] ** 2 + c[3], np.sin(c[0])]) for c in chi])
    mean = w_m @ y
    return mean, (y - mean).T @ np.diag(w_c) @ (y - mean), (chi - x).T @ np.diag(w_c) @ (y - mean)


@PROPERTY
@given(st.integers(0, 10**6), st.floats(0.05, 1.0), st.floats(1.0, 4.0), st.floats(-3.0, 3.0))
def test_sums_and_differences_are_the_textbooks_weighted_sums(seed, alpha, beta, kappa):
    x, P, _ = gaussian(seed)
    L = unscented.root(P)
    t = unscented.transform(curved, x, L, unscented.weights(N, alpha, beta, kappa))
    mean, cov, cross = textbook(x, P, alpha, beta, kappa)
    scale = 1.0 + np.abs(cov).max()
    np.testing.assert_allclose(t.mean, mean, atol=1e-9 * scale)
    np.testing.assert_allclose(t.cov, cov, atol=1e-9 * scale)
    np.testing.assert_allclose(L @ t.slope.T, cross, atol=1e-9 * scale)


@PROPERTY
@given(st.integers(0, 10**6), st.floats(1e-3, 1.0), st.floats(1.0, 4.0), st.floats(-3.0, 3.0))
def test_covariances_are_never_negative(seed, alpha, beta, kappa):
    x, P, _ = gaussian(seed)
    t = unscented.transform(curved, x, unscented.root(P), unscented.weights(N, alpha, beta, kappa))
    assert np.linalg.eigvalsh(t.curvature).min() > -1e-6 * (1.0 + np.abs(np.asarray(t.cov)).max())


@PROPERTY
@given(st.integers(0, 10**6), st.floats(0.01, 1.0))
def test_linear_functions_are_exact(seed, alpha):
    x, P, C = gaussian(seed)
    L = unscented.root(P)
    t = unscented.transform(lambda x: C @ x, x, L, unscented.weights(N, alpha))
    np.testing.assert_allclose(t.mean, C @ x, atol=1e-11)
    np.testing.assert_allclose(t.slope, C @ L, atol=1e-10)
    np.testing.assert_allclose(t.curvature, np.zeros((M, M)), atol=1e-10)


def test_mean_of_a_square_is_exact():
    """E x^2 = mean^2 + variance, which a linearisation misses."""
    t = unscented.transform(lambda x: x**2, np.array([0.5]), unscented.root(np.array([[0.09]])), unscented.weights(1))
    np.testing.assert_allclose(t.mean, [0.34], atol=1e-12)
    np.testing.assert_allclose(t.cov, [[4 * 0.25 * 0.09 + 2 * 0.09**2]], atol=1e-9)  # exact for a Gaussian


def test_singular_covariances_have_a_root():
    P = np.zeros((N, N))
    P[:2, :2] = np.ones((2, 2))
    L = np.asarray(unscented.root(P))
    assert np.isfinite(L).all()
    np.testing.assert_allclose(L @ L.T, P, atol=1e-12)


@PROPERTY
@given(st.integers(0, 10**6), st.lists(st.booleans(), min_size=M, max_size=M))
def test_update_is_kalmans_for_what_is_valid(seed, valid):
    x, P, C = gaussian(seed)
    valid, R = np.array(valid), np.array([0.1, 0.2, 0.3])
    L = unscented.root(P)
    t = unscented.transform(lambda x: C @ x, x, L, unscented.weights(N))
    S = C @ P @ C.T + np.diag(R)
    K = np.asarray(unscented.gain(L @ t.slope.T, S, valid))
    expected = np.linalg.solve(S[np.ix_(valid, valid)], C[valid] @ P).T
    np.testing.assert_allclose(K[:, valid], expected, atol=1e-10)
    assert (K[:, ~valid] == 0).all()
    P_after = np.asarray(unscented.corrected(L, t, K, R))
    np.testing.assert_allclose(P_after, P - expected @ C[valid] @ P, atol=1e-9)
    assert np.linalg.eigvalsh(P_after).min() > 0


@pytest.mark.parametrize(
    "options, says",
    [
        ({"alpha": 0.0}, "alpha must be above zero"),
        ({"alpha": 1.5}, "alpha must lie between 0 and 1"),
        ({"kappa": -4.0}, "kappa must be above -4"),
        ({"alpha": 1.0, "beta": 0.5}, "beta must be at least alpha"),
        ({"beta": np.nan}, "beta holds NaN"),
    ],
)
def test_bad_weights_are_refused(options, says):
    with pytest.raises(ConfigError, match=says):
        unscented.weights(N, **options)
