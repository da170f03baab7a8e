"""Interacting multiple model: healthy, or one rotor weak, as modes of a Markov chain that mix their estimates in every step.

    c_i = sum_j p_ji mu_j,   w_ji = p_ji mu_j / c_i                                 p_ji: from mode j to mode i in one step
    s0_i = sum_j w_ji s_ji,  P0_i = sum_j w_ji (P_ji + (s_ji - s0_i)(s_ji - s0_i)')
    then a filter for each mode from (s0_i, P0_i), and mu_i = c_i Lambda_i / sum c Lambda

s_ji is what mode j's estimate is in mode i: the same state; the loss goes with its own mode, and whoever enters a faulty mode from
another one brings a loss of N(0, theta_var). Modes and their filters: `maths/multiple_model.py`.
Source: Blom and Bar-Shalom, The interacting multiple model algorithm for systems with Markovian switching coefficients, IEEE
Trans. Automatic Control 33 (1988) 780-783; for actuator faults Zhang and Li, Detection and diagnosis of sensor and actuator
failures using IMM estimator, IEEE Trans. Aerospace and Electronic Systems 34 (1998) 1293-1313.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.backend import jax, jnp
from rotorwatch.maths import multiple_model
from rotorwatch.maths.multiple_model import Bank, Output


class IMM(multiple_model.MultipleModel):
    """Interacting multiple model on any plant that can be differentiated; `Output.probability` says how probable each mode is."""

    name, called = "imm", "The interacting multiple model"
    not_kalman = "it assumes that one rotor at a time is weak, and weighs one filter for each by how well they predict"

    def __init__(
        self, system, dt: float, *, theta_walk=1e-3, theta_var=0.1, healthy_s=100.0, weak_s=1000.0, common: bool = True
    ):
        """dt: s. theta_walk: variance that the loss of a faulty mode gains per second [1/s]; theta_var: variance of a loss that
        has just begun. healthy_s, weak_s: mean time for which the vehicle stays healthy, and a rotor weak [s]. common: one mode more,
        in which all rotors lose alike. Raises ConfigError for wrong values."""
        super().__init__(system, dt, theta_walk, theta_var, common)
        self.stay_s = multiple_model.stay(len(self.directions), healthy_s, weak_s)

    def init(self) -> Bank:
        """The plant's start, healthy for certain."""
        modes = len(self.directions)
        return multiple_model.start(self.system, modes, self.theta_var, np.arange(modes) == 0)

    def transition(self, dt):
        """(M, M) p_ji: row j, the probability of each mode dt seconds after mode j. All other modes are equally likely."""
        modes = len(self.stay_s)
        leave = -jnp.expm1(-dt / self.stay_s) / (modes - 1)
        return jnp.where(np.eye(modes) > 0, 1.0 - (modes - 1) * leave, leave[:, None])

    def step(self, carry: Bank, u, y, valid, dt=None) -> tuple[Bank, Output]:
        """Mix, predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        dt = self.dt if dt is None else dt
        s, P, predicted = self._mixed(carry, self.transition(dt))
        new = multiple_model.filtered(self.system, self.directions, s, P, self.theta_walk, u, y, valid, dt)
        probability = multiple_model.posterior(predicted, new.fit)
        out = multiple_model.combined(self.directions, new, predicted, probability, valid)
        return Bank(new.s, new.P, probability), out

    def _mixed(self, carry: Bank, p):
        """s0 (M, n_x + 1), P0 and c (M,)."""
        n, modes = self.system.n_x, len(self.directions)
        predicted = carry.probability @ p
        weight = (p * carry.probability[:, None] / predicted).T  # row i: of the modes j that mode i comes from
        own = np.eye(modes)

        def enter(w, own, theta_var):
            keep = jnp.concatenate([jnp.ones((modes, n)), own[:, None]], axis=1)
            fresh = jnp.zeros((n + 1, n + 1)).at[n, n].set(theta_var)
            P = keep[:, :, None] * carry.P * keep[:, None, :] + (1.0 - own)[:, None, None] * fresh
            return multiple_model.moments(w, keep * carry.s, P)

        fresh = jnp.where(np.arange(modes) > 0, self.theta_var, 0.0)
        s, P = jax.vmap(enter)(weight, jnp.asarray(own), fresh)
        return s, P, predicted
