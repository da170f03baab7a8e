"""CUSUM on a Kalman filter's residual: the filter believes in healthy rotors, and each rotor sums up the evidence that it is weak.

For each rotor i, since its sum was last zero (F, Phi, C, D: derivatives of the plant; K, e, S: the filter's gain, innovation, covariance):

    Upsilon = F Upsilon + Phi_i,   Omega = C Upsilon + D_i,   Upsilon = Upsilon - K Omega        what a loss does to the residual
    a = a + Omega' S^-1 e,   b = b + Omega' S^-1 Omega,   g = smallest a - smallest^2 b / 2      evidence for a loss of `smallest`

g below zero starts anew; when the largest g exceeds `threshold`, its rotor has lost a / b. Source: Page's test (Biometrika 41, 1954) on the
signatures of Willsky and Jones (IEEE TAC 21, 1976).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch import checks
from rotorwatch.core import Estimate
from rotorwatch_lab.estimators.ekf import EKF
from rotorwatch_lab.maths import linearise

PRIOR_SD = 0.3  # of a loss that nothing is known of


class State(NamedTuple):
    """filter: the Kalman filter's carry. Upsilon (n_x, n), a (n,), b (n,): each rotor's signature and sums."""

    filter: Any
    Upsilon: Any
    a: Any
    b: Any


class ResidualCUSUM:
    """Page's test for each rotor, on any plant that can be differentiated."""

    name = "residual_cusum"
    not_kalman = "it says no loss until the evidence for one exceeds a threshold"

    def __init__(self, system, dt: float, *, smallest: float = 0.1, threshold: float = 8.0):
        """dt: s. smallest: the loss that is looked for, 0 to 1; threshold: evidence [nats] from which a loss is announced. Raises
        ConfigError."""
        self.filter = EKF(system, dt, theta_walk=0.0, theta_var=0.0)  # never learns a loss: its residual keeps what a loss does
        self.system, self.dt = system, self.filter.dt
        self.smallest = checks.positive("smallest", checks.between("smallest", smallest, 0.0, 1.0))
        self.threshold = checks.positive("threshold", threshold)

    def init(self) -> State:
        """The plant's start, no evidence."""
        import jax.numpy as jnp

        n_x, n = self.system.n_x, self.system.n_theta
        return State(self.filter.init(), jnp.zeros((n_x, n)), jnp.zeros(n), jnp.zeros(n))

    def step(self, carry: State, u, y, valid, dt=None) -> tuple[State, Estimate]:
        """The filter's step, then each rotor's sum."""
        import jax.numpy as jnp
        from jax.scipy.linalg import cho_solve

        system, n_x, n = self.system, self.system.n_x, self.system.n_theta
        before, healthy = carry.filter.s[:n_x], jnp.zeros(n)
        inner, seen = self.filter.step(carry.filter, u, y, valid, dt)
        x, F, Phi = linearise.transition(system, before, u, healthy, self.dt if dt is None else dt)
        _, C, D = linearise.measurement(system, x, u, healthy)
        some = jnp.where(valid, 1.0, 0.0)
        C, D = C * some[:, None], D * some[:, None]  # what is not measured says nothing
        K = seen.x_cov @ C.T / system.R(u)
        Upsilon = F @ carry.Upsilon + Phi
        Omega = C @ Upsilon + D
        weighed = cho_solve((jnp.linalg.cholesky(seen.innovation_cov), True), jnp.column_stack([Omega, seen.innovation]))
        a = carry.a + Omega.T @ weighed[:, -1]
        b = carry.b + (Omega * weighed[:, :n]).sum(axis=0)
        g = self.smallest * a - 0.5 * self.smallest**2 * b
        on = g > 0.0
        a, b, Upsilon = jnp.where(on, a, 0.0), jnp.where(on, b, 0.0), jnp.where(on, Upsilon - K @ Omega, 0.0)
        announced = (jnp.arange(n) == jnp.argmax(g)) & (g > self.threshold)
        variance = 1.0 / (b + 1.0 / PRIOR_SD**2)
        theta = jnp.where(announced, jnp.clip(a * variance, 0.0, 1.0), 0.0)
        estimate = Estimate(
            seen.x, seen.x_cov, theta, jnp.diag(np.ones(n) * variance), seen.innovation, seen.innovation_cov, seen.status
        )  # fmt: skip
        return State(inner, Upsilon, a, b), estimate
