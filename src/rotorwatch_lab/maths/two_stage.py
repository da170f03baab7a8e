"""Two-stage unscented Kalman filter: a bias-free filter of the state, a filter of the losses, and their coupling.

    prediction  F_x = D L^-1 (D: the points' mean slope times L, L L' = P_free)       r = F_x beta + df/dtheta
                P_theta- = P_theta + Q_theta        beta- = r P_theta (P_theta-)^-1
                x- = sum w f(chi, u, theta)         P_free- = P_f + r P_theta r' - beta- P_theta- beta-' + Q
    measurement points drawn again from (x-, P_free-): y-, P_yy with R, P_xy, H = H_x beta- + dh/dtheta
                S = P_yy + H P_theta- H'            K_x = P_xy P_yy^-1     K_theta = P_theta- H' S^-1
                theta += K_theta (y - y-)           beta = beta- - K_x H
                x = x- + K_x (y - y-) + beta (theta - theta-)              P_x = P_free + beta P_theta beta'

Source: Zhang, Zhang, Li, Qin and Xu, Drones 7 (2023) 12, eqs. (20)-(44), after Chen et al., IET Control Theory Appl. 12
(2018) 1781; errata in docs/methods/tsukf.md. The mean carried is the fused one, x = x_free + beta theta: what the paper
writes in x_free follows from it by putting in x_free- = x- - beta- theta, and the innovation y - h(x_free-) - H theta is that
of x-. dh/dtheta is there for plants whose losses are felt in the measurement directly. On a linear Gaussian plant this is
the augmented Kalman filter, split in two.
"""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Callable
from typing import Any, NamedTuple

from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch_lab.maths import linearise, unscented
from rotorwatch_lab.maths.small import symmetric


class State(namedtuple("State", "x P_free beta theta P_theta")):
    """Fused estimate x (n_x,). P_free (n_x, n_x): covariance of the bias-free filter. beta (n_x, n_theta): sensitivity of the state's error
    to the losses' error. theta (n_theta,), P_theta (n_theta, n_theta)."""


class Prediction(NamedTuple):
    """Prior before the measurement. x, P_free (by its root L), beta, theta: as in State. P_theta_before: without Q_theta. seen: the
    measurement of the points. e (n_y,): innovation, 0 where invalid. R (n_y,), P_yy (n_y, n_y): noise and innovation covariance of the
    bias-free filter. H (n_y, n_theta): sensitivity of the innovation to the losses."""

    x: Array
    L: Array
    beta: Array
    theta: Array
    P_theta_before: Array
    seen: unscented.Transformed
    e: Array
    R: Array
    P_yy: Array
    H: Array


def initial(system: Any, P_theta: Array) -> State:
    """Before the first measurement: the plant's x0 and P0, no loss, and no coupling yet."""
    n_x, n_theta = system.n_x, system.n_theta
    return State(
        jnp.asarray(system.x0, float),
        jnp.asarray(system.P0, float),
        jnp.zeros((n_x, n_theta)),
        jnp.zeros(n_theta),
        jnp.asarray(P_theta, float),
    )


def predict(system: Any, w: unscented.Weights, s: State, Q_theta: Array, u: Array, y: Array, valid: Array, dt: Array) -> Prediction:
    """Predict one step ahead, and the measurement expected there. Q_theta (n_theta, n_theta): growth of P_theta in this step."""
    L = unscented.root(s.P_free)
    moved = unscented.transform(lambda x: system.f(x, u, s.theta, dt), s.x, L, w)
    r = _through(moved, L, s.beta) + jax.jacfwd(lambda theta: system.f(s.x, u, theta, dt))(s.theta)
    r_P = r @ s.P_theta
    beta = jax.scipy.linalg.cho_solve((unscented.root(s.P_theta + Q_theta), True), r_P.T).T
    # r P_theta r' - beta- P_theta- beta-', with beta- P_theta- = r P_theta put in
    P_free = moved.cov + r_P @ (r - beta).T + system.Q(dt)

    L = unscented.root(symmetric(P_free))
    seen = unscented.transform(lambda x: system.h(x, u, s.theta), moved.mean, L, w)
    H = _through(seen, L, beta) + jax.jacfwd(lambda theta: system.h(moved.mean, u, theta))(s.theta)
    R = system.R(u)
    e = jnp.where(valid, y - seen.mean, 0.0)
    return Prediction(moved.mean, L, beta, s.theta, s.P_theta, seen, e, R, seen.cov + jnp.diag(R), H)


def _through(t: unscented.Transformed, L: Array, beta: Array) -> Array:
    """Slope of the function along the columns of beta: slope L^-1 beta."""
    return t.slope @ jax.scipy.linalg.solve_triangular(L, beta, lower=True)


def update(p: Prediction, P_theta: Array, valid: Array, limit: Callable) -> tuple[State, Estimate]:
    """The measurement taken in. P_theta (n_theta, n_theta): predicted covariance of the losses, the prediction's own or a wider
    one. limit: what is done to theta, so that it stays admissible."""
    S = symmetric(p.P_yy + p.H @ P_theta @ p.H.T)
    K_x = unscented.gain(p.L @ p.seen.slope.T, p.P_yy, valid)
    K_theta = unscented.gain(P_theta @ p.H.T, S, valid)
    theta = limit(p.theta + K_theta @ p.e)
    beta = p.beta - K_x @ p.H
    rest = jnp.eye(theta.shape[0]) - K_theta @ p.H
    P_theta = symmetric(rest @ P_theta @ rest.T + K_theta @ p.P_yy @ K_theta.T)  # Joseph's form
    P_free = unscented.corrected(p.L, p.seen, K_x, p.R)
    x = p.x + K_x @ p.e + beta @ (theta - p.theta)
    P_x = symmetric(P_free + beta @ P_theta @ beta.T)
    return State(x, P_free, beta, theta, P_theta), Estimate(x, P_x, theta, P_theta, p.e, S, linearise.status(valid))
