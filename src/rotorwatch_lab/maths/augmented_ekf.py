"""Augmented extended Kalman filter with fixed or adaptive process noise: base of ekf and aekf.

    s = [x; theta],   theta(k+1) = theta(k) + walk,   s- = [f(x, u, theta); theta],   A = [F Phi; 0 I],   H = [C D]
    P- = A P A' + q^1/2 blkdiag(Q, theta_walk dt) q^1/2,   K = P- H' (H P- H' + R)^-1,   s = s- + K (y - h(s-)),   P = (I - K H) P-

q is 1, or follows the innovations by the MIT rule (`mit_rule`). Source: Jazwinski, Stochastic Processes and Filtering Theory, 1970, ch. 8.
"""

from __future__ import annotations

from typing import NamedTuple

from rotorwatch.base.backend import jnp
from rotorwatch.core import Array, Estimate
from rotorwatch_lab.maths import linearise, mit_rule, plant


class Carry(NamedTuple):
    """s = [x; theta] (n_x + n_theta,) and its covariance P. mit: the adaptation of Q, or an empty tuple without one."""

    s: Array
    P: Array
    mit: mit_rule.MitState | tuple = ()


class AugmentedEKF:
    """Base class. A method sets `name` and `not_kalman`, and chooses whether Q adapts."""

    def __init__(self, system, dt: float, *, theta_walk, theta_var, adaptation: mit_rule.Adaptation | None = None):
        """dt: s. theta_walk: variance that a loss gains per second [1/s]; theta_var: variance of the losses at the start;
        both a number or one per theta. Raises ConfigError for wrong values."""
        self.system, self.dt = plant.checked("The extended Kalman filter", system, dt), dt
        n = system.n_theta
        self.theta_walk = linearise.variances("theta_walk", theta_walk, n)
        self.theta_var = linearise.variances("theta_var", theta_var, n)
        self.adaptation = adaptation

    def init(self) -> Carry:
        """The plant's start, no loss."""
        s, P = plant.start(self.system, jnp.diag(self.theta_var))
        return Carry(s, P, mit_rule.init(len(s), self.system.n_y, self.adaptation) if self.adaptation else ())

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        system, n_x = self.system, self.system.n_x
        dt = self.dt if dt is None else dt
        x, theta, P = carry.s[:n_x], carry.s[n_x:], carry.P
        x, F, Phi = linearise.transition(system, x, u, theta, dt)
        P = self._predicted(P, F, Phi, dt, carry.mit)
        y_, C, D = linearise.measurement(system, x, u, theta)
        H, R = jnp.concatenate([C, D], axis=1), system.R(u)
        e = jnp.where(valid, y - y_, 0.0)
        S = H @ P @ H.T + jnp.diag(R)
        s, P, _ = linearise.update(jnp.concatenate([x, theta]), P, H, e, R, valid)
        estimate = Estimate(s[:n_x], P[:n_x, :n_x], s[n_x:], P[n_x:, n_x:], e, 0.5 * (S + S.T), linearise.status(valid))
        mit = carry.mit
        if self.adaptation and isinstance(mit, mit_rule.MitState):
            mit = mit_rule.adapt(mit, H, S, e, valid, dt, self.adaptation)
        return Carry(s, P, mit), estimate

    def _predicted(self, P, F, Phi, dt, mit):
        """A P A' + noise, block by block: A = [F Phi; 0 I]."""
        n_x = self.system.n_x
        A = linearise.augmented(F, Phi)
        P = A @ P @ A.T
        Q = jnp.zeros_like(P).at[:n_x, :n_x].set(self.system.Q(dt)).at[n_x:, n_x:].set(jnp.diag(self.theta_walk) * dt)
        return P + (mit_rule.scaled(Q, mit) if self.adaptation else Q)
