"""The two-stage unscented Kalman filter in the paper's own variables, each erratum as a switch: to see what it does.

With all switches off this is `estimators.TSUKF` on plants with a linear h, written another way: dense inverses, the bias-free
mean carried; kappa is 0. Zhang, Zhang, Li, Qin and Xu, Drones 7 (2023) 12, eqs. (20)-(44).
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any

import numpy as np

from rotorwatch.core import Array
from rotorwatch_lab.systems.rigid_body import RigidBody

READINGS = ("no_redraw", "centre", "gain_covariance", "inverse", "kappa", "euler_rates")


class Carry(namedtuple("Carry", "x_free P_free gamma P_gamma beta")):
    """x_free (n_x,), P_free (n_x, n_x): bias-free filter. gamma (n_theta,), P_gamma: bias filter. beta (n_x, n_theta): coupling."""


class EulerRates(RigidBody):
    """Eq. (1) as printed: the last three states are the rates of the Euler angles, and turn as body rates do."""

    def derivative(self, x, u, theta):
        """dx/dt (12,)."""
        from jax import numpy as jnp

        right = super().derivative(x, u, theta)
        return jnp.concatenate([right[:3], x[9:12], right[6:]])


class AsPrinted:
    """Two-stage UKF on a plant, all measurements valid.

    reading: any of READINGS. no_redraw: measurement points are the propagated ones. centre: points are drawn around the
    bias-free mean, and losses move them by r gamma. gain_covariance: P_gamma is corrected with P_yy where S belongs. inverse:
    F_x and H_x divide by covariances where their roots belong. kappa: 3 - n. euler_rates is a matter of the plant: `EulerRates`.
    """

    def __init__(self, system: Any, dt: float, Q_gamma, P0_gamma, reading: tuple[str, ...] = (), alpha=0.1, beta=2.0):
        """Q_gamma, P0_gamma (n_theta, n_theta): growth per step, and start, of the losses' covariance."""
        self.system, self.dt, self.Q_gamma, self.P0_gamma = system, dt, Q_gamma, P0_gamma
        self.reading = {name: name in reading for name in READINGS}
        n = system.n_x
        size = alpha**2 * (3.0 if self.reading["kappa"] else n)  # n + lambda = alpha^2 (n + kappa)
        self.spread = np.sqrt(size)
        self.w_mean = np.full(2 * n + 1, 0.5 / size)
        self.w_mean[0] = 1.0 - n / size
        self.w_cov = self.w_mean.copy()
        self.w_cov[0] += 1.0 - alpha**2 + beta

    def init(self) -> Carry:
        """The plant's x0 and P0."""
        from jax import numpy as jnp

        s, n = self.system, self.system.n_theta
        return Carry(jnp.asarray(s.x0), jnp.asarray(s.P0), jnp.zeros(n), jnp.asarray(self.P0_gamma), jnp.zeros((s.n_x, n)))

    def step(self, carry: Carry, u, y) -> tuple[Carry, Array]:
        """Predict and update with input u (n_u,) and measurement y (n_y,); returns the carry and gamma (n_theta,)."""
        import jax
        from jax import numpy as jnp

        s, dt, n = self.system, self.dt, self.system.n_x
        x_free, P_free, gamma, P_gamma, beta = carry
        centre = x_free if self.reading["centre"] else x_free + beta @ gamma

        def points(x, root):
            return x + self.spread * jnp.concatenate([jnp.zeros((1, n)), root.T, -root.T])

        def slope(values, P, root):
            divisor = P if self.reading["inverse"] else root
            return (values[1 : n + 1] - values[n + 1 :]).T @ jnp.linalg.inv(divisor) / (2.0 * self.spread)

        def covariance(a, b):
            return (a * self.w_cov[:, None]).T @ b

        root = jnp.linalg.cholesky(P_free)
        F_r = jax.jacfwd(lambda gamma: s.f(centre, u, gamma, dt))(gamma)
        losses = jnp.zeros_like(gamma) if self.reading["centre"] else gamma
        moved = jax.vmap(lambda x: s.f(x, u, losses, dt))(points(centre, root))
        r = slope(moved, P_free, root) @ beta + F_r
        P_gamma_minus = P_gamma + self.Q_gamma
        beta_minus = r @ P_gamma @ jnp.linalg.inv(P_gamma_minus)
        moved = moved - beta_minus @ gamma + (r @ gamma if self.reading["centre"] else 0.0)
        x_minus = self.w_mean @ moved
        P_minus = covariance(moved - x_minus, moved - x_minus) + s.Q(dt)
        P_minus = P_minus + r @ P_gamma @ r.T - beta_minus @ P_gamma_minus @ beta_minus.T
        P_minus = 0.5 * (P_minus + P_minus.T)

        root = jnp.linalg.cholesky(P_minus)
        chosen = moved if self.reading["no_redraw"] else points(x_minus, root)
        seen = jax.vmap(lambda x: s.h(x, u, gamma))(chosen)
        y_minus = self.w_mean @ seen
        P_yy = covariance(seen - y_minus, seen - y_minus) + jnp.diag(s.R(u))
        K_x = covariance(chosen - x_minus, seen - y_minus) @ jnp.linalg.inv(P_yy)
        H = slope(seen, P_minus, root) @ beta_minus
        S = P_yy + H @ P_gamma_minus @ H.T
        K_gamma = P_gamma_minus @ H.T @ jnp.linalg.inv(S)
        gamma_next = gamma + K_gamma @ (y - y_minus - H @ gamma)
        P_gamma_next = P_gamma_minus - K_gamma @ (P_yy if self.reading["gain_covariance"] else S) @ K_gamma.T
        carry = Carry(
            x_minus + K_x @ (y - y_minus),
            P_minus - K_x @ P_yy @ K_x.T,
            gamma_next,
            0.5 * (P_gamma_next + P_gamma_next.T),
            beta_minus - K_x @ H,
        )
        return carry, gamma_next
