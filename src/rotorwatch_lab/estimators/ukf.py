"""Augmented unscented Kalman filter: states and losses are one vector, and points are drawn from their joint Gaussian.

    z = (x, theta),  theta a random walk;   z- = sum w (f(chi), chi_theta),   P- = P_f + diag(Q, Q_theta)
    points drawn again from (z-, P-):  y-, P_yy + R, P_zy;   K = P_zy S^-1;   z = z- + K (y - y-),   P = P- - K S K'

Source: Julier and Uhlmann, Proc. IEEE 92 (2004); the yardstick of the two-stage filters. docs/methods/ukf.md.
"""

from __future__ import annotations

from collections import namedtuple

from rotorwatch.base.backend import jax
from rotorwatch.core import Estimate
from rotorwatch_lab.maths import plant, unscented


class Carry(namedtuple("Carry", "z P")):
    """z (n_x + n_theta,): states, then losses. P: its covariance."""


class UKF(unscented.Unscented):
    """Augmented UKF on any plant with f, h, Q and R."""

    name = "ukf"

    def init(self) -> Carry:
        """The plant's x0 and P0, no loss."""
        return Carry(*plant.start(self.system, self.theta_var))

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        dt = self.dt if dt is None else dt
        noise = jax.scipy.linalg.block_diag(self.system.Q(dt), dt * self.theta_walk)
        z, P, out, _ = unscented.joint_step(self.system, self.weights, *carry, noise, u, y, valid, dt, self.limit)
        return Carry(z, P), out
