"""Two-stage unscented Kalman filter: points are drawn for the states only, losses are carried by a linear coupling.

Equations: `rotorwatch_lab.maths.two_stage`. Source: Zhang et al., Drones 7 (2023) 12, eqs. (20)-(44). docs/methods/tsukf.md.
"""

from __future__ import annotations

from rotorwatch.core import Estimate
from rotorwatch_lab.maths import two_stage, unscented


class TSUKF(unscented.Unscented):
    """Two-stage UKF on any plant with f, h, Q and R; as good as the augmented UKF where losses act nearly linearly."""

    name, joint = "tsukf", False

    def init(self) -> two_stage.State:
        """The plant's x0 and P0, no loss."""
        return two_stage.initial(self.system, self.theta_var)

    def step(self, carry: two_stage.State, u, y, valid, dt=None) -> tuple[two_stage.State, Estimate]:
        """Predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        dt = self.dt if dt is None else dt
        Q_theta = dt * self.theta_walk
        p = two_stage.predict(self.system, self.weights, carry, Q_theta, u, y, valid, dt)
        return two_stage.update(p, carry.P_theta + Q_theta, valid, self.limit)
