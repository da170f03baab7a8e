"""Adaptive unscented Kalman filter: the augmented UKF whose process noise follows its innovations by the MIT rule.

    z = (x, theta),   P- = P_f + q^1/2 blkdiag(Q, Q_theta) q^1/2,   q adapted after each step: `mit_rule`

Source: the baseline of Qi, Song, Dai, Han and Wang 2015; Julier and Uhlmann, Proc. IEEE 92 (2004). docs/methods/aukf.md.
"""

from __future__ import annotations

from typing import NamedTuple

from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch_lab.maths import linearise, mit_rule, plant, unscented


class Carry(NamedTuple):
    """z (n_x + n_theta,): states, then losses. P: its covariance. mit: the adaptation."""

    z: Array
    P: Array
    mit: mit_rule.MitState


class AUKF(unscented.Unscented):
    """Augmented UKF with adaptive process noise, on any plant with f, h, Q and R."""

    name, called = "aukf", "The adaptive unscented Kalman filter"
    not_kalman = "it adapts the process noise to its innovations"

    def __init__(self, system, dt, *, theta_walk=1e-3, theta_var=1e-2, eta=0.5, window_s=1.0, alpha=1.0, beta=2.0, kappa=0.0):
        """Arguments of `unscented.Unscented`, and: eta: rate of adaptation [1/s]; window_s: measured time over which innovations are
        averaged [s]. Raises ConfigError."""
        super().__init__(system, dt, theta_walk=theta_walk, theta_var=theta_var, alpha=alpha, beta=beta, kappa=kappa)
        self.adaptation = mit_rule.adaptation(eta, window_s, dt)

    def init(self) -> Carry:
        """The plant's x0 and P0, no loss."""
        z, P = plant.start(self.system, self.theta_var)
        return Carry(z, P, mit_rule.init(P.shape[0], self.system.n_y, self.adaptation))

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        system, dt = self.system, self.dt if dt is None else dt
        noise = mit_rule.scaled(jax.scipy.linalg.block_diag(system.Q(dt), dt * self.theta_walk), carry.mit)
        z, P, out, middle = unscented.joint_step(system, self.weights, carry.z, carry.P, noise, u, y, valid, dt)
        seen = linearise.measurement(system, middle[: system.n_x], u, middle[system.n_x :])
        H = jnp.concatenate([seen.by_x, seen.by_theta], axis=1)
        mit = mit_rule.adapt(carry.mit, H, out.innovation_cov, out.innovation, valid, dt, self.adaptation)
        return Carry(z, P, mit), out
