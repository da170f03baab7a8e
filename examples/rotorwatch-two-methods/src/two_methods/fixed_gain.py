"""Fixed-gain observer: states and losses are corrected by one constant gain, that of the stationary Kalman filter at hover.

    x- = f(x, u, theta),   e = y - h(x-, u, theta),   [x; theta] = [x-; theta] + K e

K is what the Riccati recursion of the augmented plant, linearised at (x0, u0) without losses, comes to after `rounds` steps. Source: the
Luenberger observer with the gain of Kalman's stationary filter, as in any textbook (Anderson and Moore, Optimal Filtering, 1979, ch. 4).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import checks
from rotorwatch.core import Estimate
from rotorwatch_lab.maths import linearise


class State(NamedTuple):
    """x (n_x,) and theta (n_theta,)."""

    x: Any
    theta: Any


@functools.cache
def _stationary():
    """Gain, covariance of the innovation and covariance after the update that the Riccati recursion comes to; compiled once for all plants
    of a size: the matrices are arguments, not constants."""
    import jax
    import jax.numpy as jnp

    def gain(P, H, R):
        return jnp.linalg.solve(H @ P @ H.T + R, H @ P).T

    def updated(P, H, R):
        P = P - gain(P, H, R) @ H @ P
        return 0.5 * (P + P.T)

    @functools.partial(jax.jit, static_argnames="rounds")
    def stationary(A, H, Q, R, start, rounds):
        def turn(_, P):
            P = A @ updated(P, H, R) @ A.T + Q
            return 0.5 * (P + P.T)

        P = jax.lax.fori_loop(0, rounds, turn, start)
        return gain(P, H, R), H @ P @ H.T + R, updated(P, H, R)

    return stationary


class FixedGain:
    """A constant gain on any plant that can be differentiated."""

    name = "fixed_gain"
    not_kalman = "its gain is the stationary one from the first step on, whatever was measured"

    def __init__(self, system, dt: float, *, theta_walk: float = 1e-3, u0=None, rounds: int = 400):
        """dt: s. theta_walk: variance that a loss gains per second [1/s]. u0 (n_u,): input about which the gain is made; default: 1 for
        each rotor, which is hover on the plants of logs. rounds: of the Riccati recursion. Raises ConfigError for wrong values."""
        import jax.numpy as jnp

        checks.has(system, "The fixed-gain observer", "f", "h", "Q", "R", "x0", "P0")
        self.system, self.dt = system, checks.positive("dt", dt)
        checks.positive("theta_walk", theta_walk)
        n_x, n = system.n_x, system.n_theta
        u0 = np.ones(system.n_u) if u0 is None else checks.finite("u0", checks.shape("u0", u0, system.n_u))
        x0, healthy = jnp.asarray(system.x0, float), jnp.zeros(n)
        _, F, Phi = linearise.transition(system, x0, jnp.asarray(u0), healthy, dt)
        _, C, D = linearise.measurement(system, x0, jnp.asarray(u0), healthy)
        A = jnp.block([[F, Phi], [jnp.zeros((n, n_x)), jnp.eye(n)]])
        H, R = jnp.concatenate([C, D], axis=1), jnp.diag(system.R(jnp.asarray(u0)))
        Q = jnp.zeros((n_x + n, n_x + n)).at[:n_x, :n_x].set(system.Q(dt)).at[n_x:, n_x:].set(theta_walk * dt * jnp.eye(n))

        start = jnp.zeros_like(Q).at[:n_x, :n_x].set(jnp.asarray(system.P0)).at[n_x:, n_x:].set(0.01 * jnp.eye(n))
        self.K, self.S, self.P = _stationary()(A, H, Q, R, start, rounds)

    def init(self) -> State:
        """The plant's start, no loss."""
        import jax.numpy as jnp

        return State(jnp.asarray(self.system.x0, float), jnp.zeros(self.system.n_theta))

    def step(self, carry: State, u, y, valid, dt=None) -> tuple[State, Estimate]:
        """Predict over dt with input u (n_u,), then correct with y (n_y,) where valid."""
        import jax.numpy as jnp

        system, n_x = self.system, self.system.n_x
        x = system.f(carry.x, u, carry.theta, self.dt if dt is None else dt)
        e = jnp.where(valid, y - system.h(x, u, carry.theta), 0.0)
        change = self.K @ e
        new = State(x + change[:n_x], carry.theta + change[n_x:])
        P = self.P
        estimate = Estimate(new.x, P[:n_x, :n_x], new.theta, P[n_x:, n_x:], e, self.S, linearise.status(valid))
        return new, estimate
