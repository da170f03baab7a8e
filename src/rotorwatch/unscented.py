"""The unscented transform: a Gaussian represented by 2 n + 1 points that any function can be applied to.

    chi_0 = x,   chi_i = x +- sqrt(n + lambda) L e_i,   L L' = P,   lambda = alpha^2 (n + kappa) - n
    mean  = sum w_m f(chi),   covariance = sum w_c (f(chi) - mean) (f(chi) - mean)'

Source: Julier and Uhlmann, Unscented filtering and nonlinear estimation, Proc. IEEE 92 (2004). Points are rows of arrays:
the centre, then n on the plus side, then n on the minus side. With weights that are not negative (the default) every
covariance made here is positive semidefinite by construction. Pure functions for use inside compiled steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from rotorwatch import checks
from rotorwatch.core import Array
from rotorwatch.errors import ConfigError

# What is added to a diagonal before its root is taken: relative, so that rounding does not make a singular covariance
# indefinite; absolute, so that a state that is known exactly still has two distinct points (1e-10 of its unit apart).
RELATIVE, ABSOLUTE = 1e-14, 1e-20


class Weights(NamedTuple):
    """spread: sqrt(n + lambda), how far out the points lie in standard deviations. mean_0, cov_0: of the centre. side: of
    each other point."""

    spread: float
    mean_0: float
    cov_0: float
    side: float


class Transformed(NamedTuple):
    """A function of a Gaussian. mean (m,). deviations (2 n + 1, m): its points minus the mean. slope (m, n): its mean derivative
    times L, from the differences of opposite points. curvature (m, m): what its covariance has beyond slope slope', 0 where
    the function is linear."""

    mean: Array
    deviations: Array
    slope: Array
    curvature: Array

    @property
    def cov(self) -> Array:
        """(m, m) sum w_c (f(chi) - mean)(f(chi) - mean)'."""
        return self.slope @ self.slope.T + self.curvature


def weights(n: int, alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0) -> Weights:
    """Weights for n dimensions. alpha in (0, 1]: how far out; beta: 2 for a Gaussian; kappa > -n.

    The default puts no weight on the centre's mean, so that none is negative. Raises ConfigError.
    """
    checks.positive("alpha", alpha)
    checks.finite("beta", beta)
    checks.finite("kappa", kappa)
    if n + kappa <= 0:
        raise ConfigError(f"kappa must be above -{n}, the dimension, not {kappa:g}.")
    size = alpha**2 * (n + kappa)
    mean_0 = (size - n) / size
    return Weights(math.sqrt(size), mean_0, mean_0 + 1.0 - alpha**2 + beta, 0.5 / size)


def root(P: Array) -> Array:
    """Lower factor L (n, n) with L L' = P, also where P is singular."""
    from jax import numpy as jnp

    return jnp.linalg.cholesky(P + jnp.diag(RELATIVE * jnp.diagonal(P) + ABSOLUTE))


def points(x: Array, L: Array, w: Weights) -> Array:
    """(2 n + 1, n) points of the Gaussian with mean x (n,) and covariance L L'."""
    from jax import numpy as jnp

    out = w.spread * L.T
    return jnp.concatenate([x[None], x + out, x - out])


def transform(function: Callable, x: Array, L: Array, w: Weights) -> Transformed:
    """The function (n,) -> (m,) of the Gaussian with mean x and covariance L L'."""
    import jax

    values = jax.vmap(function)(points(x, L, w))
    n = x.shape[0]
    from_centre = values - values[0]  # the mean as a difference: no loss of digits where weights are large
    shift = w.side * from_centre[1:].sum(axis=0)
    plus, minus = from_centre[1 : n + 1], from_centre[n + 1 :]
    even = 0.5 * (plus + minus) - shift  # what opposite points have in common; slope is what they have not
    curvature = 2.0 * w.side * even.T @ even + w.cov_0 * shift[:, None] * shift[None, :]
    return Transformed(values[0] + shift, from_centre - shift, (plus - minus).T / (2.0 * w.spread), curvature)


def covariance(a: Array, b: Array, w: Weights) -> Array:
    """(m, k) covariance of deviations a (2 n + 1, m) with b (2 n + 1, k)."""
    return w.side * (a[1:].T @ b[1:]) + w.cov_0 * a[0][:, None] * b[0][None, :]


def gain(P_xy: Array, S: Array, valid: Array) -> Array:
    """K = P_xy S^-1 (n, m) of the measurements that are valid (m,) bool; 0 for the others."""
    from jax import numpy as jnp
    from jax.scipy.linalg import cho_solve

    both = valid[:, None] & valid[None, :]
    S = jnp.where(both, S, jnp.eye(valid.shape[0]))
    return cho_solve((jnp.linalg.cholesky(S), True), jnp.where(valid[:, None], P_xy.T, 0.0)).T


def corrected(L: Array, y: Transformed, K: Array, R: Array) -> Array:
    """Covariance after the update x + K (y - h), in Joseph's form: (L - K D)(L - K D)' + K (C + diag(R)) K'.

    L (n, n): root of the predicted covariance that the points of h were drawn with; D, C: slope and curvature of h. R (m,):
    variances. Equal to P - K S K' for K = L D' S^-1, and positive semidefinite for any K.
    """
    from jax import numpy as jnp

    rest = L - K @ y.slope
    return symmetric(rest @ rest.T + K @ (y.curvature + jnp.diag(R)) @ K.T)


def symmetric(P: Array) -> Array:
    """P without the asymmetry that rounding brought."""
    return 0.5 * (P + P.T)
