"""Interacting multiple model: healthy, or one rotor weak, as modes of a Markov chain that mix their estimates in every step.

Mode 0: every rotor is healthy, theta = 0. Mode m: theta = d_m l, with the loss l of one rotor (d_m a unit vector), or of all rotors
alike (d_m ones: a battery, thin air). Each mode has an extended Kalman filter of s = [x; l]; l is 0 for ever in mode 0.

    c_i = sum_j p_ji mu_j,   w_ji = p_ji mu_j / c_i                                 p_ji: from mode j to mode i in one step
    s0_i = sum_j w_ji s_ji,  P0_i = sum_j w_ji (P_ji + (s_ji - s0_i)(s_ji - s0_i)')
    A = [F Phi d; 0 1],   P- = A P0 A' + blkdiag(Q, walk dt),   H = [C D d],   e = y - h(x-, u, d l),   S = H P- H' + R
    Lambda_i = N(e; 0, S),   mu_i = c_i Lambda_i / sum c Lambda

s_ji is what mode j's estimate is in mode i: the same state; the loss goes with its own mode, and whoever enters a faulty mode from
another one brings a loss of N(0, theta_var). The estimate is the mean and covariance of the mixture of all modes.
Source: Blom and Bar-Shalom, The interacting multiple model algorithm for systems with Markovian switching coefficients, IEEE
Trans. Automatic Control 33 (1988) 780-783; for actuator faults Zhang and Li, Detection and diagnosis of sensor and actuator
failures using IMM estimator, IEEE Trans. Aerospace and Electronic Systems 34 (1998) 1293-1313; the mixture's moments: Bar-Shalom, Li and
Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, sections 11.6.2 and 11.6.6.
"""

from __future__ import annotations

from collections import namedtuple
from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch_lab.maths import linearise, plant


class Bank(namedtuple("Bank", "s P probability")):
    """s (M, n_x + 1) and P (M, n_x + 1, n_x + 1): state and loss of each mode. probability (M,): of each mode."""


class Output(NamedTuple):
    """estimate: of all modes together. probability (M,): of each mode. loss (M,): loss in each mode, 0 in mode 0."""

    estimate: Estimate
    probability: Array
    loss: Array


class Updated(namedtuple("Updated", "s P e S fit")):
    """Posterior of one mode: s, P as in Bank; e (n_y,) and S (n_y, n_y): innovation and its covariance; fit: log Lambda."""


class _Along:
    """A plant whose theta is d l: one number l."""

    def __init__(self, system: Any, d: Array):
        self.system, self.d = system, d

    def f(self, x, u, loss, dt):
        return self.system.f(x, u, self.d * loss[0], dt)

    def h(self, x, u, loss):
        return self.system.h(x, u, self.d * loss[0])


class IMM:
    """Interacting multiple model on any plant that can be differentiated; `Output.probability` holds the probability of each mode."""

    name = "imm"
    not_kalman = "it assumes that one rotor at a time is weak, and weighs one filter for each by how well they predict"

    def __init__(self, system, dt: float, *, theta_walk=1e-3, theta_var=0.1, healthy_s=100.0, weak_s=1000.0, common: bool = True):
        """dt: s. theta_walk: variance that the loss of a faulty mode gains per second [1/s]; theta_var: variance of a loss that
        has just begun. healthy_s, weak_s: mean time for which the vehicle stays healthy, and a rotor weak [s]. common: one mode more,
        in which all rotors lose alike. Raises ConfigError for wrong values."""
        self.system, self.dt = plant.checked("The interacting multiple model", system, dt), dt
        for name, value in (("theta_walk", theta_walk), ("theta_var", theta_var)):
            checks.between(name, checks.shape(name, value), 0.0, np.inf)
        self.theta_walk, self.theta_var = theta_walk, theta_var
        self.directions = directions(system, common)
        self.faulty = np.arange(len(self.directions)) > 0
        times = checks.positive("weak_s", weak_s), checks.positive("healthy_s", healthy_s)
        self.stay_s = np.where(self.faulty, *times)

    def init(self) -> Bank:
        """The plant's start, healthy for certain."""
        n, modes = self.system.n_x, len(self.directions)
        s = jnp.concatenate([jnp.asarray(self.system.x0, float), jnp.zeros(1)])
        P = jnp.zeros((n + 1, n + 1)).at[:n, :n].set(jnp.asarray(self.system.P0, float))
        P = jnp.broadcast_to(P, (modes, n + 1, n + 1)).at[:, n, n].set(jnp.where(self.faulty, self.theta_var, 0.0))
        return Bank(jnp.broadcast_to(s, (modes, n + 1)), P, jnp.asarray(~self.faulty, float))

    def transition(self, dt):
        """(M, M) p_ji: row j, the probability of each mode dt seconds after mode j. All other modes are equally likely."""
        modes = len(self.stay_s)
        leave = -jnp.expm1(-dt / self.stay_s) / (modes - 1)
        return jnp.where(np.eye(modes) > 0, 1.0 - (modes - 1) * leave, leave[:, None])

    def step(self, carry: Bank, u, y, valid, dt=None) -> tuple[Bank, Output]:
        """Mix, predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        dt = self.dt if dt is None else dt
        s, P, predicted = self._mixed(carry, self.transition(dt))
        new = filtered(self.system, self.directions, s, P, self.theta_walk, u, y, valid, dt)
        weight = predicted * jnp.exp(new.fit - new.fit.max())  # no underflow, whatever the size of the likelihoods
        probability = weight / weight.sum()
        out = combined(self.directions, new, predicted, probability, valid)
        return Bank(new.s, new.P, probability), out

    def _mixed(self, carry: Bank, p):
        """s0 (M, n_x + 1), P0 and c (M,)."""
        n, modes = self.system.n_x, len(self.directions)
        predicted = carry.probability @ p
        weight = (p * carry.probability[:, None] / predicted).T  # row i: of the modes j that mode i comes from
        same_mode = np.eye(modes)

        def enter(w, same_mode, theta_var):
            keep = jnp.concatenate([jnp.ones((modes, n)), same_mode[:, None]], axis=1)
            fresh = jnp.zeros((n + 1, n + 1)).at[n, n].set(theta_var)
            P = keep[:, :, None] * carry.P * keep[:, None, :] + (1.0 - same_mode)[:, None, None] * fresh
            return moments(w, keep * carry.s, P)

        fresh = jnp.where(self.faulty, self.theta_var, 0.0)
        s, P = jax.vmap(enter)(weight, jnp.asarray(same_mode), fresh)
        return s, P, predicted


def directions(system: Any, common: bool) -> np.ndarray:
    """(M, n_theta) d of each mode: none, each theta alone, and with `common` all losses alike where there are two or more."""
    n = system.n_theta
    losses = sum(name.startswith("loss") for name in getattr(system, "theta_names", ())) or n
    rows = [np.zeros((1, n)), np.eye(n)]
    if common and losses > 1:
        rows.append((np.arange(n) < losses)[None].astype(float))
    return np.concatenate(rows)


def filtered(system: Any, d: Array, s: Array, P: Array, walk: Array, u: Array, y: Array, valid: Array, dt: Array) -> Updated:
    """Predict and update every mode's filter from s (M, n_x + 1) and P. d (M, n_theta); walk: variance that a loss gains per second."""
    n = system.n_x
    Q, R = system.Q(dt), system.R(u)

    def one(d, s, P, walk):
        along = _Along(system, d)
        x, F, Phi = linearise.transition(along, s[:n], u, s[n:], dt)
        A = linearise.augmented(F, Phi)
        P = A @ P @ A.T
        P = P + jnp.zeros_like(P).at[:n, :n].set(Q).at[n, n].set(walk * dt)
        s = jnp.concatenate([x, s[n:]])
        y_, C, D = linearise.measurement(along, x, u, s[n:])
        H = jnp.concatenate([C, D], axis=1)
        S = H @ P @ H.T + jnp.diag(R)
        e = jnp.where(valid, y - y_, 0.0)
        s, P, fit = linearise.update(s, P, H, e, R, valid)
        return Updated(s, P, e, S, fit)

    d = jnp.asarray(d)
    return jax.vmap(one)(d, s, P, jnp.where((d != 0.0).any(axis=1), walk, 0.0))


def combined(d: Array, new: Updated, predicted: Array, probability: Array, valid: Array) -> Output:
    """All modes as one estimate; the innovation is that of the prediction before the update."""
    n = new.s.shape[1] - 1
    x, x_cov = moments(probability, new.s[:, :n], new.P[:, :n, :n])
    loss = new.s[:, n]
    spread = d[:, :, None] * d[:, None, :] * new.P[:, n, n][:, None, None]
    theta, theta_cov = moments(probability, d * loss[:, None], spread)
    e, S = moments(predicted, new.e, new.S)
    estimate = Estimate(x, x_cov, theta, theta_cov, e, S, linearise.status(valid))
    return Output(estimate, probability, loss)


def moments(weight: Array, mean: Array, P: Array):
    """Mean (n,) and symmetric covariance (n, n) of a mixture: weight (M,), mean (M, n), P (M, n, n)."""
    m = weight @ mean
    away = mean - m
    total = jnp.einsum("m,mij->ij", weight, P) + (weight * away.T) @ away
    return m, 0.5 * (total + total.T)
