"""Multiple-model adaptive estimation: one filter for each weak rotor and one for none, each for itself, weighed by likelihood.

    mu_m = max(mu_m Lambda_m / sum mu Lambda, floor), then divided by their sum

Nothing is mixed and nothing switches: each filter runs as if its mode had held from the start. The floor keeps a mode that was
wrong for long from becoming impossible. Modes and their filters: `maths/multiple_model.py`.
Source: Magill, Optimal adaptive estimation of sampled stochastic processes, IEEE Trans. Automatic Control 10 (1965) 434-439;
Maybeck, Multiple model adaptive algorithms for detecting and compensating sensor and actuator/surface failures in aircraft
flight control systems, Int. J. Robust and Nonlinear Control 9 (1999) 1051-1070, for the floor.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.maths import multiple_model
from rotorwatch.maths.multiple_model import Bank, Output


class MMAE(multiple_model.MultipleModel):
    """Multiple-model adaptive estimation on any plant that can be differentiated."""

    name, called = "mmae", "Multiple-model adaptive estimation"
    not_kalman = "it assumes that one rotor at most is weak, and weighs one filter for each by how well they predict"

    def __init__(self, system, dt: float, *, theta_walk=1e-2, theta_var=0.1, floor: float = 1e-3, common: bool = True):
        """dt: s. theta_walk: variance that the loss of a faulty mode gains per second [1/s]; theta_var: its variance at the start.
        floor: least probability of a mode. common: one mode more, in which all rotors lose alike. Raises ConfigError."""
        super().__init__(system, dt, theta_walk, theta_var, common)
        self.floor = checks.between("floor", checks.positive("floor", floor), 0.0, 0.5 / len(self.directions))

    def init(self) -> Bank:
        """The plant's start, every mode equally probable."""
        modes = len(self.directions)
        return multiple_model.start(self.system, modes, self.theta_var, np.full(modes, 1.0 / modes))

    def step(self, carry: Bank, u, y, valid, dt=None) -> tuple[Bank, Output]:
        """Predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        dt = self.dt if dt is None else dt
        new = multiple_model.filtered(self.system, self.directions, carry.s, carry.P, self.theta_walk, u, y, valid, dt)
        floored = jnp.maximum(multiple_model.posterior(carry.probability, new.fit), self.floor)
        probability = jnp.where(valid.any(), floored / floored.sum(), carry.probability)
        out = multiple_model.combined(self.directions, new, carry.probability, probability, valid)
        return Bank(new.s, new.P, probability), out
