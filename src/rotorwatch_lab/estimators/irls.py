"""Iteratively reweighted least squares over a window: losses as coefficients of the model's equation, outliers counting less.

    theta = argmin sum_i rho(r_i / s) s^2 + theta' theta / theta_var,   r_i = z_i - Omega_i theta, over the rows of the window
    by  w_i = psi(r_i / s) / (r_i / s),   theta = (I / theta_var + sum w Omega' Omega / s^2)^-1 sum w Omega' z / s^2,   repeated

    Huber    w = min(1, c s / |r|), c = 1.345              Tukey    w = (1 - (r / c s)^2)^2 below c s, else 0, c = 4.685
    s^2 = mean min(r^2, k^2 s^2) / beta, k = 1.5, beta = E min(Z^2, k^2) for a standard normal Z; s >= 1

z = Omega theta + noise is the regression of `maths/measured_regression.py`, whitened, so that s = 1 where the plant's noise is
right. Source: Holland and Welsch, Robust regression using iteratively reweighted least squares, Communications in Statistics A6 (1977)
813-827; Huber, Robust Statistics, 1981, section 7.8, for the scale ("proposal 2").
"""

from __future__ import annotations

import math
from typing import NamedTuple

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp, lax
from rotorwatch.core import Array, Estimate
from rotorwatch_lab.maths import linearise, measured_regression

# Constants of 95 % efficiency where noise is normal, and of the scale.
CONSTANT = {"huber": 1.345, "tukey": 4.685}
K = 1.5
BETA = math.erf(K / math.sqrt(2.0)) - math.sqrt(2.0 / math.pi) * K * math.exp(-0.5 * K * K) + K * K * math.erfc(K / math.sqrt(2.0))


class Carry(NamedTuple):
    """known: the measured state. z (N, n_y), Omega (N, n_y, n_theta), seen (N, n_y): the window, in any order; next: int32, the row
    to write. theta (n_theta,), its covariance P; s: scale of the residuals."""

    known: measured_regression.Known
    z: Array
    Omega: Array
    seen: Array
    next: Array
    theta: Array
    P: Array
    s: Array


class IRLS:
    """Windowed robust least squares on any plant whose states are all measured."""

    name = "irls"
    not_kalman = "it weighs outliers down and forgets what is older than its window"

    def __init__(
        self, system, dt: float, *, window_s=1.0, theta_var=0.1, weights: str = "huber", constant: float | None = None, iterations: int = 5
    ):
        """dt: s. window_s: length of the window [s]. theta_var: variance of the losses before any measurement, a number or one per
        theta. weights: huber or tukey; constant: their c, in standard deviations (None: 95 % efficiency). iterations: reweightings
        of a step. Raises ConfigError for wrong values, and for plants with unmeasured states."""
        self.system, self.dt = system, measured_regression.check("Iteratively reweighted least squares", system, dt)
        self.rows = max(2, round(checks.positive("window_s", window_s) / dt))
        self.theta_var = checks.positive("theta_var", linearise.variances("theta_var", theta_var, system.n_theta))
        self.weights = checks.one_of("weights", weights, CONSTANT)
        self.c = checks.positive("constant", CONSTANT[weights] if constant is None else constant)
        self.iterations = checks.whole("iterations", iterations, 1)

    def init(self) -> Carry:
        """The plant's start, no loss, an empty window."""
        n_y, n = self.system.n_y, self.system.n_theta
        empty = jnp.zeros((self.rows, n_y))
        return Carry(
            measured_regression.start(self.system),
            empty,
            jnp.zeros((self.rows, n_y, n)),
            empty,
            jnp.int32(0),
            jnp.zeros(n),
            jnp.diag(self.theta_var),
            jnp.ones(()),
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u (n_u,), then add y (n_y,), where valid, to the window and fit it again."""
        dt = self.dt if dt is None else dt
        row = measured_regression.row(self.system, carry.known, u, y, valid, carry.theta, dt)
        z, Omega = measured_regression.whitened(row, valid)

        def pushed(window, new):
            put = lax.dynamic_update_index_in_dim(window, new, carry.next, 0)
            return jnp.where(valid.any(), put, window)

        window = pushed(carry.z, z), pushed(carry.Omega, Omega), pushed(carry.seen, valid.astype(float))
        theta, P, s = self._fitted(*window, carry.theta, carry.s)
        theta, P, s = (jnp.where(valid.any(), new, old) for new, old in ((theta, carry.theta), (P, carry.P), (s, carry.s)))
        following = carry.next + valid.any().astype(jnp.int32)
        following = jnp.where(following == self.rows, 0, following).astype(jnp.int32)
        known = measured_regression.measured(row, y, valid, theta)
        out = measured_regression.estimate(row, known, valid, carry.P, theta, P)
        return Carry(known, *window, following, theta, P, s), out

    def _fitted(self, z, Omega, seen, theta, s):
        """theta, P and s after the iterations, from those before. A row counts as often as it was measured."""
        n = theta.shape[0]
        flat, target, seen = Omega.reshape(-1, n), z.reshape(-1), seen.reshape(-1)
        P = jnp.diag(self.theta_var)
        for _ in range(self.iterations):
            r = target - flat @ theta
            s = jnp.sqrt((jnp.minimum(r * r, (K * s) ** 2) * seen).sum() / (BETA * jnp.maximum(seen.sum(), 1.0)))
            s = jnp.maximum(s, 1.0)
            weighted = flat * (self._weight(r / s) * seen / (s * s))[:, None]
            information = weighted.T @ flat + jnp.diag(1.0 / self.theta_var)
            theta, P = linearise.posterior(information, weighted.T @ target)
        return theta, P, s

    def _weight(self, r):
        if self.weights == "huber":
            return self.c / jnp.maximum(jnp.abs(r), self.c)
        return jnp.maximum(1.0 - (r / self.c) ** 2, 0.0) ** 2
