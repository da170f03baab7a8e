"""Adaptive Kalman filter: Zhang's filter of a linear plant, or of one linearised at points known beforehand.

    x- = f(a, u, 0) + F (x - a) + Phi theta,   y- = h(a, u, 0) + C (x- - a) + D theta

with F, Phi, C, D the derivatives at a, the point of linearisation, and theta = 0; then the recursion of
`maths/adaptive_kalman.py`. Source: Zhang, Automatica 93 (2018).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import adaptive_kalman, linearise
from rotorwatch_lab.maths.adaptive_kalman import MEMORY_S


class Carry(NamedTuple):
    """state: of the recursion. k: int32, steps made, to find the point of linearisation."""

    state: adaptive_kalman.State
    k: Array


class AKF(adaptive_kalman.Zhang):
    """Adaptive Kalman filter about one point, or about a known trajectory."""

    name = "akf"

    def __init__(self, system, dt: float, *, memory_s: float | None = MEMORY_S, theta_var=0.01, s_max: float | None = 1.0, about=None):
        """dt: s. memory_s: time after which a measurement counts 1/e for the losses [s], None to forget nothing; theta_var: variance of
        the losses at the start, a number or one per theta; s_max: bound of that variance, None for none. about: (n_x,) where to
        linearise (default: x0), or (T, n_x), a point per step, the last one from then on. Raises ConfigError for wrong values."""
        super().__init__(system, dt, memory_s=memory_s, theta_var=theta_var, s_max=s_max)
        about = system.x0 if about is None else checks.finite("about", about)
        if np.ndim(about) not in (1, 2) or np.shape(about)[-1] != system.n_x or np.size(about) == 0:
            raise ConfigError(f"about must have the shape ({system.n_x},) or (T, {system.n_x}), not {np.shape(about)}.")
        self.about = about

    def init(self) -> Carry:
        """The plant's start, no loss."""
        return Carry(self.start(), np.int32(0))

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        system, (state, k) = self.system, carry
        seconds = self.dt if dt is None else dt
        a, healthy = self._point(k), jnp.zeros(system.n_theta)
        f = linearise.transition(system, a, u, healthy, seconds)
        h = linearise.measurement(system, a, u, healthy)
        x = f.value + f.by_x @ (state.x - a) + f.by_theta @ state.theta
        e = y - (h.value + h.by_x @ (x - a) + h.by_theta @ state.theta)
        state, estimate = self.recursion(state, x, f, e, h, u, valid, dt)
        return Carry(state, (k + 1).astype(jnp.int32)), estimate

    def _point(self, k):
        points = jnp.asarray(self.about, float)
        if points.ndim == 1:
            return points
        return jax.lax.dynamic_index_in_dim(points, jnp.minimum(k, len(points) - 1), keepdims=False)
