"""Adaptive exogenous Kalman filter: Zhang's filter, linearised about the state of a separate observer.

    1. z+ = f(z, u, theta) + L (y(k) - h(z, u, theta))                             the observer, with the measurement of step k
    2. x- = f(z, u, theta) + F (x - z),   F, Phi at (z, theta)                     the filter, linearised at z
       e  = y(k+1) - h(z+, u, theta) - C (x- - z+),   C, D at (z+, theta)

then the recursion of `maths/adaptive_kalman.py`. Neither a wrong start nor an overconfident P can spoil the
linearisation, because z does not depend on them. Source: Rot, Hasan and Manoonpong, Robust actuator fault diagnosis algorithm
for autonomous hexacopter UAVs, IFAC-PapersOnLine 53-2 (2020); what was corrected: docs/methods/axkf.md.
"""

from __future__ import annotations

from typing import NamedTuple

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.core import Array, Estimate
from rotorwatch_lab.maths import adaptive_kalman, linearise, observer_gain
from rotorwatch_lab.maths.adaptive_kalman import MEMORY_S

S_MAX = 1e8
"""Keeps the digits of a loss that nothing excites, and stands in no loss's way: the paper's Q and R are tuning, with which a loss that is
measured well ends at a variance of 2e6."""


class Carry(NamedTuple):
    """state: of the recursion. z (n_x,): the observer's state. correction (n_x,): what the last measurement adds to it."""

    state: adaptive_kalman.State
    z: Array
    correction: Array


class AXKF(adaptive_kalman.Zhang):
    """Adaptive exogenous Kalman filter on any plant that can be differentiated."""

    name = "axkf"

    def __init__(
        self, system, dt: float, *, gain=None, memory_s: float | None = MEMORY_S, theta_var=0.01, s_max: float | None = S_MAX, z0=None
    ):
        """dt: s. gain: (n_x, n_y) of the observer, for steps of dt; default: the stationary Kalman gain at x0, and others are
        made by `rotorwatch_lab.maths.observer_gain`. memory_s: time after which a measurement counts 1/e for the losses [s], None to
        forget nothing; theta_var: variance of the losses at the start, a number or one per theta; s_max: bound of that variance, None
        for none. z0: (n_x,) where the observer starts (default: x0). Raises ConfigError for wrong values."""
        super().__init__(system, dt, memory_s=memory_s, theta_var=theta_var, s_max=s_max)
        if gain is None:
            gain = observer_gain.stationary(system, dt)
        self.gain = checks.finite("gain", checks.shape("gain", gain, system.n_x, system.n_y))
        self.z0 = system.x0 if z0 is None else checks.finite("z0", checks.shape("z0", z0, system.n_x))

    def init(self) -> Carry:
        """The plant's start, no loss."""
        z = jnp.asarray(self.z0, float)
        return Carry(self.start(), z, jnp.zeros_like(z))

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        system, state = self.system, carry.state
        seconds = self.dt if dt is None else dt
        f = linearise.transition(system, carry.z, u, state.theta, seconds)
        z = f.value + carry.correction
        x = f.value + f.by_x @ (state.x - carry.z)
        h = linearise.measurement(system, z, u, state.theta)
        e = y - (h.value + h.by_x @ (x - z))
        state, estimate = self.recursion(state, x, f, e, h, u, valid, dt)
        # What the measurement adds to the observer acts with the next step, in which its loss is known: h + D dtheta.
        seen = h.value + h.by_theta @ (state.theta - carry.state.theta)
        correction = jnp.asarray(self.gain) @ jnp.where(valid, y - seen, 0.0)
        return Carry(state, z, correction), estimate
