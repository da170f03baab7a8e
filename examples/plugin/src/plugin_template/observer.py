"""An estimator: a gradient observer. States follow the measurement, losses what the states leave unexplained.

    e = y - h(f(x, u, theta), u, theta),   x = f(x, u, theta) + trust C' e,   theta = theta + speed D' W e

C, D: derivatives of the prediction by x and theta; W = diag(1 / (R + |rows of D|^2)). Source: normalised gradient adaptation, as in
any textbook on adaptive control (Ioannou and Sun, Robust Adaptive Control, 1996, ch. 4).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from rotorwatch import checks
from rotorwatch.core import Estimate


class State(NamedTuple):
    """x (n_x,) and theta (n_theta,)."""

    x: Any
    theta: Any


class Observer:
    """Constant gains on any plant that can be differentiated."""

    name = "template_observer"
    not_kalman = "its gains are numbers that were chosen"

    def __init__(self, system, dt: float, *, trust: float = 0.3, speed: float = 0.05):
        """dt: s. trust, speed: gains of the states and of the losses. Raises ConfigError for wrong values."""
        self.system, self.dt = system, checks.positive("dt", dt)
        self.trust, self.speed = checks.positive("trust", trust), checks.positive("speed", speed)

    def init(self) -> State:
        """The plant's start, no loss."""
        import jax.numpy as jnp

        return State(jnp.asarray(self.system.x0, float), jnp.zeros(self.system.n_theta))

    def step(self, carry: State, u, y, valid, dt=None) -> tuple[State, Estimate]:
        """One step over dt with input u (n_u,), measurement y (n_y,) where valid."""
        import jax
        import jax.numpy as jnp

        system, seconds = self.system, self.dt if dt is None else dt

        def predict(x, theta):
            return system.h(system.f(x, u, theta, seconds), u, theta)

        C, D = jax.jacfwd(predict, argnums=(0, 1))(carry.x, carry.theta)
        R = jnp.asarray(system.R(u))
        e = jnp.where(valid, y - predict(carry.x, carry.theta), 0.0)
        x = system.f(carry.x, u, carry.theta, seconds) + self.trust * C.T @ e
        theta = jnp.clip(carry.theta + self.speed * D.T @ (e / (R + (D**2).sum(axis=1))), 0.0, 1.0)
        n_x, n = system.n_x, system.n_theta
        status = jnp.where(valid.any(), 0, 2).astype(jnp.int32)
        return State(x, theta), Estimate(x, jnp.eye(n_x), theta, 0.01 * jnp.eye(n), e, jnp.diag(R), status)
