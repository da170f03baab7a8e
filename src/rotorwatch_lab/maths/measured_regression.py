"""Losses as the coefficients of a linear regression, on plants whose states are all measured.

    x- = f(x_m, u, theta0)                          x_m: the state as it was last measured, with the covariance P
    Upsilon- = F Upsilon + Phi                      how x- follows theta
    z  = y - h(x-, u, theta0) + Omega theta0,       Omega = C Upsilon- + D,  z = Omega theta + noise
    S  = C (F P F' + Q) C' + R                      covariance of the noise
    x_m+ = x- + Upsilon- (theta - theta0) + K (y - its prediction),     Upsilon = Upsilon- - K Omega,     K: left inverse of C

One step of the model from the measured state predicts a measurement; what it misses is what the losses did. On rate dynamics this is
d(omega)/dt from differences of the gyro, and the accelerometer's thrust, against what the commands would do. Noise of neighbouring
rows is correlated (one measurement ends a step and starts the next one): with equal weights it cancels, so that S is cautious.
A state that is not measured is predicted with the losses as estimated, and Upsilon keeps what that does, so that the first row after
a gap regresses on all of the gap. Where all is measured Upsilon is 0.
Source: equation error or "direct" regression, Ljung, System Identification, 2nd ed. 1999, section 10.1; Klein and Morelli, Aircraft
System Identification, 2006, chapter 5.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import linearise, plant
from rotorwatch_lab.maths.small import symmetric

TINY = 1e-12


class Known(namedtuple("Known", "x P Upsilon")):
    """x (n_x,), P (n_x, n_x): the state as last measured, and its covariance were theta known. Upsilon (n_x, n_theta): how x follows
    theta, 0 but for what was not measured."""


class Row(namedtuple("Row", "theta z Omega S x P Upsilon y C R")):
    """A step's regression about `theta`: z (n_y,), Omega (n_y, n_theta), S (n_y, n_y); the state predicted, x (n_x,), P and Upsilon; y
    (n_y,) and C (n_y, n_x): the measurement predicted; R (n_y,)."""


def check(method: str, system: Any, dt: Any) -> Any:
    """dt, where the plant offers what is needed and all its states are measured. Raises ConfigError elsewhere."""
    plant.checked(method, system, dt)
    u, theta = jnp.ones(system.n_u), jnp.zeros(system.n_theta)
    C = linearise.measurement(system, jnp.asarray(system.x0, float), u, theta).by_x
    if checks.concrete(C) and np.linalg.matrix_rank(np.asarray(C)) < system.n_x:
        raise ConfigError(
            f"{method} is not defined for the plant {system.name}: it needs every state measured, because it compares each "
            "step of the model with the states that were measured before and after it."
        )
    return dt


def start(system: Any) -> Known:
    """The plant's x0 and P0."""
    return Known(jnp.asarray(system.x0, float), jnp.asarray(system.P0, float), jnp.zeros((system.n_x, system.n_theta)))


def row(system: Any, known: Known, u: Array, y: Array, valid: Array, theta: Array, dt: Array) -> Row:
    """The regression of a step of dt seconds, about theta (n_theta,). Rows of z that are not valid hold nothing of use."""
    x, F, Phi = linearise.transition(system, known.x, u, theta, dt)
    ahead, C, D = linearise.measurement(system, x, u, theta)
    Upsilon = F @ known.Upsilon + Phi
    Omega, R = C @ Upsilon + D, system.R(u)
    P = F @ known.P @ F.T + system.Q(dt)
    z = jnp.where(valid, y - ahead, 0.0) + Omega @ theta
    return Row(theta, z, Omega, symmetric(C @ P @ C.T + jnp.diag(R)), x, P, Upsilon, ahead, C, R)


def left_inverse(C: Array) -> Array:
    """(n_x, n_y) (C' C)^-1 C'; one refinement takes out the error of TINY."""
    factor = jnp.linalg.cholesky(C.T @ C + TINY * jnp.eye(C.shape[1]))
    left = jax.scipy.linalg.cho_solve((factor, True), C.T)
    return 2.0 * left - left @ (C @ left)


def whitened(regression: Row, valid: Array) -> tuple[Array, Array]:
    """z (n_y,) and Omega (n_y, n_theta) with noise of the covariance I; rows that are not valid are 0."""
    S = jnp.where(valid[:, None] & valid[None, :], regression.S, np.eye(len(valid)))
    both = jnp.where(valid[:, None], jnp.concatenate([regression.Omega, regression.z[:, None]], axis=1), 0.0)
    white = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(S), both, lower=True)
    return white[:, -1], white[:, :-1]


def measured(regression: Row, y: Array, valid: Array, theta: Array) -> Known:
    """The state after the step, theta (n_theta,) being the losses as they are known now."""
    moved = theta - regression.theta
    left = left_inverse(regression.C)
    # Below this a coefficient is the rounding of TINY: the measurement is not needed for that state.
    needed = jnp.abs(left) > 1e-9 * jnp.abs(left).max()
    complete = (valid | ~needed).all(axis=1) & needed.any(axis=1)
    K = jnp.where(complete[:, None] & needed, left, 0.0)
    rest = np.eye(len(regression.x)) - K @ regression.C
    e = jnp.where(valid, y - regression.y - regression.Omega @ moved, 0.0)
    x = regression.x + regression.Upsilon @ moved + K @ e
    P = rest @ regression.P @ rest.T + (K * regression.R) @ K.T
    return Known(x, symmetric(P), regression.Upsilon - K @ regression.Omega)


def estimate(regression: Row, after: Known, valid: Array, before_cov: Array, theta: Array, theta_cov: Array) -> Estimate:
    """The posterior of a step; the innovation is against the losses before it, whose covariance was before_cov."""
    e = jnp.where(valid, regression.z - regression.Omega @ regression.theta, 0.0)
    S = symmetric(regression.S + regression.Omega @ before_cov @ regression.Omega.T)
    x_cov = symmetric(after.P + after.Upsilon @ theta_cov @ after.Upsilon.T)
    return Estimate(after.x, x_cov, theta, symmetric(theta_cov), e, S, linearise.status(valid))
