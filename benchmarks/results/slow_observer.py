"""The method of docs/your-own-method.md."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from rotorwatch.core import Estimate


class State(NamedTuple):
    x: object
    theta: object


class SlowObserver:
    """A gradient observer: states follow the measurement, losses follow what the states leave unexplained."""

    name = "slow_observer"
    not_kalman = "its gains are numbers that were chosen"  # empty for a method that is Kalman's filter on linear plants

    def __init__(self, system, dt, *, trust=0.3, speed=0.05):
        self.system, self.dt, self.trust, self.speed = system, dt, trust, speed

    def init(self):
        return State(jnp.asarray(self.system.x0, float), jnp.zeros(self.system.n_theta))

    def step(self, carry, u, y, valid, dt=None):
        system, seconds = self.system, self.dt if dt is None else dt
        predict = lambda theta: system.h(system.f(carry.x, u, theta, seconds), u, theta)
        e = jnp.where(valid, y - predict(carry.theta), 0.0)
        slope = jax.jacfwd(predict)(carry.theta)
        C = jax.jacfwd(lambda x: system.h(x, u, carry.theta))(carry.x)
        x = system.f(carry.x, u, carry.theta, seconds) + self.trust * C.T @ e
        weight = 1.0 / (system.R(u) + (slope**2).sum(axis=1))
        theta = carry.theta + self.speed * slope.T @ (weight * e)
        n, n_x = system.n_theta, system.n_x
        S = jnp.diag(system.R(u))
        status = jnp.where(valid.any(), 0, 2).astype(jnp.int32)
        out = Estimate(x, jnp.eye(n_x), theta, 0.01 * jnp.eye(n), e, S, status)
        return State(x, theta), out
