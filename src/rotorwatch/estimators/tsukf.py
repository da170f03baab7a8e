"""Two-stage unscented Kalman filter: points are drawn for the states only, losses are carried by a linear coupling.

Equations: `rotorwatch.maths.two_stage`. Source: Zhang et al., Drones 7 (2023) 12, section 3.1. docs/methods/tsukf.md.
"""

from __future__ import annotations

from typing import Any

from rotorwatch.core import Estimate
from rotorwatch.maths import plant, two_stage, unscented


class TSUKF:
    """Two-stage UKF on any plant with f, h, Q and R; as good as the augmented UKF where losses act nearly linearly."""

    name = "tsukf"
    not_kalman = ""

    def __init__(
        self, system: Any, dt: float, *, theta_walk=1e-3, theta_var=1e-2, clip=False, alpha=0.1, beta=2.0, kappa=0.0
    ):
        """dt: step [s]. theta_walk: variance that a loss gains per second [1/s]; theta_var: its variance at the start; each a
        number for all, one for each (n_theta,), or a covariance. clip: keep actuators' losses in [0, 1]. alpha, beta, kappa:
        where the points lie, `unscented.weights`. Raises ConfigError.
        """
        self.system, self.dt = plant.checked("tsukf", system, dt), dt
        n = system.n_theta
        self.theta_walk = two_stage.loss_covariance("theta_walk", theta_walk, n)
        self.theta_var = two_stage.loss_covariance("theta_var", theta_var, n)
        self.limit = two_stage.to_unit(min(system.n_u, n)) if clip else two_stage.no_limit
        self.weights = unscented.weights(system.n_x, alpha, beta, kappa)

    def init(self) -> two_stage.State:
        """The plant's x0 and P0, no loss."""
        return two_stage.initial(self.system, self.theta_var)

    def step(self, carry: two_stage.State, u, y, valid, dt=None) -> tuple[two_stage.State, Estimate]:
        """One time step; arguments as in `core.Estimator`."""
        dt = self.dt if dt is None else dt
        Q_theta = dt * self.theta_walk
        p = two_stage.predict(self.system, self.weights, carry, Q_theta, u, y, valid, dt)
        return two_stage.update(p, carry.P_theta + Q_theta, valid, self.limit)
