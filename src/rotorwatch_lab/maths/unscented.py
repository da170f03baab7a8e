"""The unscented transform: a Gaussian represented by 2 n + 1 points that any function can be applied to.

    chi_0 = x,   chi_i = x +- sqrt(n + lambda) L e_i,   L L' = P,   lambda = alpha^2 (n + kappa) - n
    mean  = sum w_m f(chi),   covariance = sum w_c (f(chi) - mean) (f(chi) - mean)'

With the symmetric points everything follows from sums and differences of opposite values, measured from the centre's,
d_i+- = f(chi_i+-) - f(x):

    mean  = f(x) + m,  m = w sum (d_i+ + d_i-),  w = 1 / 2 (n + lambda)          slope D = [(d_i+ - d_i-) / 2 sqrt(n + lambda)]
    covariance = D D' + 2 w sum e_i e_i' + (beta - alpha^2) m m',  e_i = (d_i+ + d_i-) / 2          with x itself: L D'

which loses no digits for small alpha, and shows that covariances are positive semidefinite when beta >= alpha^2. Source:
Julier and Uhlmann, Unscented filtering and nonlinear estimation, Proc. IEEE 92 (2004). Pure functions for compiled steps.
"""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import linearise, plant
from rotorwatch_lab.maths.small import definite_solve, symmetric

# What is added to a diagonal before its root is taken: relative, so that rounding does not make a singular covariance
# indefinite; absolute, so that a state that is known exactly still has two distinct points (1e-10 of its unit apart).
RELATIVE, ABSOLUTE = 1e-14, 1e-20


class Weights(NamedTuple):
    """spread: sqrt(n + lambda), how far out the points lie in standard deviations. side: weight of each point but the centre.
    bend: beta - alpha^2, what the centre adds to covariances."""

    spread: float
    side: float
    bend: float


class Transformed(namedtuple("Transformed", "mean slope curvature")):
    """A function of a Gaussian. mean (m,). slope D (m, n): its mean derivative times L. curvature (m, m): what its covariance
    has beyond D D'; 0 where the function is linear."""

    @property
    def cov(self) -> Array:
        """(m, m) covariance."""
        return self.slope @ self.slope.T + self.curvature


def weights(n: int, alpha: float = 0.1, beta: float = 2.0, kappa: float = 0.0) -> Weights:
    """Weights for n dimensions. alpha in (0, 1]: how far out the points lie, alpha sqrt(n + kappa) standard deviations; beta: 2
    for a Gaussian; kappa > -n. Raises ConfigError."""
    checks.between("alpha", checks.positive("alpha", alpha), 0.0, 1.0)
    checks.finite("beta", beta)
    checks.finite("kappa", kappa)
    if n + kappa <= 0:
        raise ConfigError(f"kappa must be above -{n}, the dimension, not {kappa:g}.")
    if beta < alpha**2:
        raise ConfigError(f"beta must be at least alpha^2 = {alpha**2:g}, or covariances turn negative, not {beta:g}.")
    size = alpha**2 * (n + kappa)
    return Weights(math.sqrt(size), 0.5 / size, beta - alpha**2)


def root(P: Array) -> Array:
    """Lower factor L (n, n) with L L' = P, also where P is singular."""
    return jnp.linalg.cholesky(P + jnp.diag(RELATIVE * jnp.diagonal(P) + ABSOLUTE))


def points(x: Array, L: Array, w: Weights) -> Array:
    """(2 n + 1, n) points of the Gaussian with mean x (n,) and covariance L L': the centre, the plus side, the minus side."""
    out = w.spread * L.T
    return jnp.concatenate([x[None], x + out, x - out])


def transform(function: Callable, x: Array, L: Array, w: Weights) -> Transformed:
    """The function (n,) -> (m,) of the Gaussian with mean x and covariance L L'."""
    values = jax.vmap(function)(points(x, L, w))
    n = x.shape[0]
    plus, minus = values[1 : n + 1] - values[0], values[n + 1 :] - values[0]
    e = 0.5 * (plus + minus)
    m = 2.0 * w.side * e.sum(axis=0)
    curvature = 2.0 * w.side * e.T @ e + w.bend * m[:, None] * m[None, :]
    return Transformed(values[0] + m, (plus - minus).T / (2.0 * w.spread), curvature)


def gain(P_xy: Array, S: Array, valid: Array) -> Array:
    """K = P_xy S^-1 (n, m) of the measurements that are valid (m,) bool; 0 for the others."""
    both = valid[:, None] & valid[None, :]
    S = jnp.where(both, S, jnp.eye(valid.shape[0]))
    return definite_solve(S, jnp.where(valid[:, None], P_xy.T, 0.0)).T


def corrected(L: Array, y: Transformed, K: Array, R: Array) -> Array:
    """Covariance after the update x + K (y - h), in Joseph's form: (L - K D)(L - K D)' + K (C + diag(R)) K'.

    L (n, n): root of the predicted covariance that the points of h were drawn with; D, C: slope and curvature of h. R (m,):
    variances. Equal to P - K S K' for K = L D' S^-1, and positive semidefinite for any K.
    """
    rest = L - K @ y.slope
    return symmetric(rest @ rest.T + K @ (y.curvature + jnp.diag(R)) @ K.T)


def joint_step(system, w: Weights, z, P, noise, u, y, valid, dt, limit: Callable = lambda theta: theta):
    """Predict and update a filter of states and losses together: (z, P, Estimate, predicted z).

        z- = sum w (f(chi), chi_theta),   P- = P_f + noise;   points drawn again from (z-, P-):  y-, P_yy, P_zy
        S = P_yy + R,   K = P_zy S^-1;   z = z- + K (y - y-),   P = P- - K S K'

    z (n_x + n_theta,), P and noise square. limit: what is done to the new losses, so that they stay admissible.
    """
    n = system.n_x

    def f(z):
        return jnp.concatenate([system.f(z[:n], u, z[n:], dt), z[n:]])

    moved = transform(f, z, root(P), w)
    L = root(symmetric(moved.cov + noise))
    seen = transform(lambda z: system.h(z[:n], u, z[n:]), moved.mean, L, w)
    R = system.R(u)
    S = symmetric(seen.cov + jnp.diag(R))
    K = gain(L @ seen.slope.T, S, valid)
    e = jnp.where(valid, y - seen.mean, 0.0)
    z = moved.mean + K @ e
    z = jnp.concatenate([z[:n], limit(z[n:])])
    P = corrected(L, seen, K, R)
    return z, P, Estimate(z[:n], P[:n, :n], z[n:], P[n:, n:], e, S, linearise.status(valid)), moved.mean


def loss_covariance(name: str, value: Any, n: int) -> Array:
    """(n, n) covariance of the losses given as a variance for all, one for each, or a matrix. Raises ConfigError."""
    if np.ndim(value) < 2:
        if np.ndim(value) == 1:
            checks.shape(name, value, n)
        xp = np if checks.concrete(value) else jnp
        value = xp.eye(n) * xp.asarray(value, float)
    return checks.covariance(name, value, n)


def no_limit(theta: Array) -> Array:
    """The limit that leaves theta unchanged."""
    return theta


def to_unit(n: int) -> Callable:
    """A limit: the first n losses (actuators, not biases) to [0, 1]."""

    def limit(theta):
        return jnp.concatenate([jnp.clip(theta[:n], 0.0, 1.0), theta[n:]])

    return limit


class Unscented:
    """Base of the unscented filters. A method sets `name` and `not_kalman`, and `joint` to False where points are drawn for the states
    only."""

    name = not_kalman = called = ""
    joint = True

    def __init__(self, system: Any, dt: float, *, theta_walk=1e-3, theta_var=1e-2, clip=False, alpha=0.1, beta=2.0, kappa=0.0):
        """dt: step [s]. theta_walk: variance that a loss gains per second [1/s]; theta_var: its variance at the start; each a
        number for all, one for each (n_theta,), or a covariance. clip: keep actuators' losses in [0, 1]. alpha, beta, kappa:
        where the points lie, `unscented.weights`. Raises ConfigError.
        """
        self.system, self.dt = plant.checked(self.called or self.name, system, dt), dt
        n = system.n_theta
        self.theta_walk = loss_covariance("theta_walk", theta_walk, n)
        self.theta_var = loss_covariance("theta_var", theta_var, n)
        self.limit = to_unit(min(system.n_u, n)) if clip else no_limit
        self.weights = weights(system.n_x + (n if self.joint else 0), alpha, beta, kappa)
