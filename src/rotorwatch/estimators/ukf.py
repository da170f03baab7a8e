"""Augmented unscented Kalman filter: states and losses are one vector, and points are drawn from their joint Gaussian.

    z = (x, theta),  theta a random walk;   z- = sum w (f(chi), chi_theta),   P- = P_f + diag(Q, Q_theta)
    points drawn again from (z-, P-):  y-, P_yy + R, P_zy;   K = P_zy S^-1;   z = z- + K (y - y-),   P = P- - K S K'

Source: Julier and Uhlmann, Proc. IEEE 92 (2004); the yardstick of the two-stage filters. docs/methods/ukf.md.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from rotorwatch.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch.maths import plant, two_stage, unscented


class Carry(NamedTuple):
    """z (n_x + n_theta,): states, then losses. P: its covariance."""

    z: Array
    P: Array


class UKF:
    """Augmented UKF on any plant with f, h, Q and R."""

    name = "ukf"
    not_kalman = ""

    def __init__(
        self, system: Any, dt: float, *, theta_walk=1e-3, theta_var=1e-2, clip=False, alpha=0.1, beta=2.0, kappa=0.0
    ):
        """dt: step [s]. theta_walk: variance that a loss gains per second [1/s]; theta_var: its variance at the start; each a
        number for all, one for each (n_theta,), or a covariance. clip: keep actuators' losses in [0, 1]. alpha, beta, kappa:
        where the points lie, `unscented.weights`. Raises ConfigError.
        """
        self.system, self.dt = plant.checked("ukf", system, dt), dt
        n = system.n_theta
        self.theta_walk = two_stage.loss_covariance("theta_walk", theta_walk, n)
        self.theta_var = two_stage.loss_covariance("theta_var", theta_var, n)
        self.limit = two_stage.to_unit(min(system.n_u, n)) if clip else two_stage.no_limit
        self.weights = unscented.weights(system.n_x + n, alpha, beta, kappa)

    def init(self) -> Carry:
        """The plant's x0 and P0, no loss."""
        x0 = jnp.asarray(self.system.x0, float)
        return Carry(
            jnp.concatenate([x0, jnp.zeros(self.system.n_theta)]),
            jax.scipy.linalg.block_diag(jnp.asarray(self.system.P0, float), self.theta_var),
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """One time step; arguments as in `core.Estimator`."""
        dt = self.dt if dt is None else dt
        noise = jax.scipy.linalg.block_diag(self.system.Q(dt), dt * self.theta_walk)
        z, P, out, _ = unscented.joint_step(
            self.system, self.weights, carry.z, carry.P, noise, u, y, valid, dt, self.limit
        )
        return Carry(z, P), out
