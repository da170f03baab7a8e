"""Adaptive extended Kalman filter: Zhang's filter linearised at its own estimate.

    x- = f(x, u, theta),   e = y - h(x-, u, theta);   F, Phi at (x, theta),   C, D at (x-, theta)

then the recursion of `maths/adaptive_kalman.py`. Source: Skriver, Helck and Hasan, Adaptive extended Kalman filter for actuator
fault diagnosis, IEEE ICSRS 2019, on Zhang, Automatica 93 (2018).
"""

from __future__ import annotations

from rotorwatch.core import Estimate
from rotorwatch_lab.maths import adaptive_kalman, linearise
from rotorwatch_lab.maths.adaptive_kalman import State


class AdaptiveEKF(adaptive_kalman.Zhang):
    """Adaptive extended Kalman filter on any plant that can be differentiated."""

    name = "adaptive_ekf"

    def init(self) -> State:
        """The plant's start, no loss."""
        return self.start()

    def step(self, carry: State, u, y, valid, dt=None) -> tuple[State, Estimate]:
        """Predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        system = self.system
        seconds = self.dt if dt is None else dt
        f = linearise.transition(system, carry.x, u, carry.theta, seconds)
        h = linearise.measurement(system, f.value, u, carry.theta)
        return self.recursion(carry, f.value, f, y - h.value, h, u, valid, dt)
