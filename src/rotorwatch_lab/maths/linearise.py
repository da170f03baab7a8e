"""First-order models of a plant, and the measurement update of a Gaussian, for linearised estimators.

    x(k+1) = f + F dx + Phi dtheta,    y = h + C dx + D dtheta

D is the direct feedthrough of a loss to a measurement (an accelerometer feels thrust at once).
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths.small import symmetric


class Linear(namedtuple("Linear", "value by_x by_theta")):
    """value (m,) at the point; by_x (m, n_x) and by_theta (m, n_theta): its derivatives there."""


def transition(system, x, u, theta, dt) -> Linear:
    """f, F and Phi: the plant's step of dt seconds about (x, theta)."""
    return _linear(lambda x, theta: system.f(x, u, theta, dt), x, theta, "f", system)


def measurement(system, x, u, theta) -> Linear:
    """h, C and D: the plant's measurement about (x, theta)."""
    return _linear(lambda x, theta: system.h(x, u, theta), x, theta, "h", system)


def _linear(g, x, theta, part: str, system) -> Linear:
    """Forward derivatives in all directions, in one pass. Raises ConfigError for a plant that calls NumPy on traced values."""
    n = x.shape[0]

    try:
        value, slope = once(lambda s: g(s[:n], s[n:]), jnp.concatenate([x, theta]))
    except (jax.errors.TracerArrayConversionError, jax.errors.ConcretizationTypeError) as why:
        name = getattr(system, "name", type(system).__name__)
        raise ConfigError(checks.untraceable(f"{part} of the plant {name}", why)) from why
    return Linear(value, slope[:, :n], slope[:, n:])


def augmented(F, Phi):
    """(n, n) transition [F Phi; 0 I] of states and constant losses."""
    n_x, n_theta = Phi.shape
    return jnp.concatenate([jnp.concatenate([F, Phi], axis=1), jnp.asarray(np.eye(n_x + n_theta)[n_x:])])


def joseph(P, K, H, R):
    """Covariance after an update with any gain K: (I - K H) P (I - K H)' + K diag(R) K', symmetric; R (m,) variances."""
    rest = np.eye(P.shape[0]) - K @ H
    return symmetric(rest @ P @ rest.T + (K * R) @ K.T)


def posterior(information, moment):
    """Mean and symmetric covariance of a Gaussian with this information matrix (n, n) and vector (n,)."""
    factor = jnp.linalg.cholesky(symmetric(information)), True
    P = jax.scipy.linalg.cho_solve(factor, np.eye(len(moment)))
    return jax.scipy.linalg.cho_solve(factor, moment), symmetric(P)


def rate(system, x, u, theta):
    """dx/dt (n_x,): the derivative of the plant's step at dt = 0."""
    return jax.jvp(lambda dt: system.f(x, u, theta, dt), (0.0,), (1.0,))[1]


def once(function, at):
    """(function(at), its Jacobian), the function evaluated once."""

    def twice(s):
        value = function(s)
        return value, value

    jacobian, value = jax.jacfwd(twice, has_aux=True)(at)
    return value, jacobian


def update(s, P, H, e, R, valid):
    """Kalman update of mean s (n,) and covariance P (n, n), one measurement after the other: R is diagonal.

    H (m, n): rows of the measurement; e (m,): y minus its prediction from s; R (m,) variances; valid (m,) bool: what is not
    valid changes nothing, whatever e holds there. The same as the update with all at once, because H stays where it was.
    Returns s, an exactly symmetric P, and the logarithm of the likelihood of what is valid.
    """
    ds, fit = jnp.zeros_like(s), 0.0
    for i in range(H.shape[0]):
        Ph = H[i] @ P
        variance = Ph @ H[i] + R[i]
        left = jnp.where(valid[i], e[i], 0.0) - H[i] @ ds
        weight = jnp.where(valid[i], 1.0 / variance, 0.0)
        fit = fit - jnp.where(valid[i], 0.5 * (jnp.log(2.0 * np.pi * variance) + left * left / variance), 0.0)
        ds = ds + Ph * (weight * left)
        P = P - (weight * Ph)[:, None] * Ph[None, :]
    return s + ds, 0.5 * (P + P.T), fit


def status(valid):
    """0 when something was measured, 2 when not: `core.Estimate.status`."""
    return jnp.where(valid.any(), 0, 2).astype(jnp.int32)


def variances(name: str, value, n: int):
    """(n,) variances from one number or n of them; raises ConfigError when they are negative or too few."""
    if np.shape(value) not in ((), (n,)):
        raise ConfigError(f"{name} must be one number or {n} of them, not an array of the shape {np.shape(value)}.")
    return checks.between(name, value, 0.0, np.inf) * np.ones(n)
