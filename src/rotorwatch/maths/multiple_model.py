"""One filter for each explanation, and how probable each is: what multiple-model estimators share.

Mode 0: every rotor is healthy, theta = 0. Mode m: theta = d_m l, with the loss l of one rotor (d_m a unit vector), or of all rotors
alike (d_m ones: a battery, thin air). Each mode has an extended Kalman filter of s = [x; l]; l is 0 for ever in mode 0.

    A = [F Phi d; 0 1],   P- = A P A' + blkdiag(Q, walk dt),   H = [C D d],   e = y - h(x-, u, d l),   S = H P- H' + R
    likelihood  Lambda = N(e; 0, S)          probability  mu_m = c_m Lambda_m / sum c Lambda,   c: probabilities predicted

Moments of all modes together: mean = sum mu mean_m,  covariance = sum mu (P_m + (mean_m - mean)(mean_m - mean)').
Source: Bar-Shalom, Li and Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001, sections 11.6.2 and 11.6.6.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch.maths import linearise, plant


class Bank(NamedTuple):
    """s (M, n_x + 1) and P (M, n_x + 1, n_x + 1): state and loss of each mode. probability (M,): of each mode."""

    s: Array
    P: Array
    probability: Array


class Output(NamedTuple):
    """estimate: of all modes together. probability (M,): of each mode. loss (M,): loss in each mode, 0 in mode 0."""

    estimate: Estimate
    probability: Array
    loss: Array


class Updated(NamedTuple):
    """One mode after a step: s, P as in Bank; e (n_y,) and S (n_y, n_y): innovation and its covariance; fit: log Lambda."""

    s: Array
    P: Array
    e: Array
    S: Array
    fit: Array


class _Along:
    """A plant whose theta is d l: one number l."""

    def __init__(self, system: Any, d: Array):
        self.system, self.d = system, d

    def f(self, x, u, loss, dt):
        return self.system.f(x, u, self.d * loss[0], dt)

    def h(self, x, u, loss):
        return self.system.h(x, u, self.d * loss[0])


class MultipleModel:
    """What the multiple-model methods share. Not a method by itself: a method sets `name`, `called` and `not_kalman`."""

    name = called = not_kalman = ""

    def __init__(self, system, dt: float, theta_walk, theta_var, common: bool):
        """The plant in steps of dt [s], the loss's walk and variance, and the modes. Raises ConfigError for wrong values."""
        self.system, self.dt = plant.checked(self.called, system, dt), dt
        for name, value in (("theta_walk", theta_walk), ("theta_var", theta_var)):
            checks.between(name, checks.shape(name, value), 0.0, np.inf)
        self.theta_walk, self.theta_var = theta_walk, theta_var
        self.directions = directions(system, common)


def stay(modes: int, healthy_s, weak_s) -> np.ndarray:
    """(modes,) mean time in each [s]: healthy first, then one weak rotor after the other. Raises ConfigError."""
    return np.where(np.arange(modes) > 0, checks.positive("weak_s", weak_s), checks.positive("healthy_s", healthy_s))


def directions(system: Any, common: bool) -> np.ndarray:
    """(M, n_theta) d of each mode: none, each theta alone, and with `common` all losses alike where there are two or more."""
    n = system.n_theta
    losses = sum(name.startswith("loss") for name in getattr(system, "theta_names", ())) or n
    rows = [np.zeros((1, n)), np.eye(n)]
    if common and losses > 1:
        rows.append((np.arange(n) < losses)[None].astype(float))
    return np.concatenate(rows)


def start(system: Any, modes: int, theta_var: Array, probability: Array) -> Bank:
    """Every mode at the plant's x0 and P0, its loss 0 with the variance theta_var; mode 0 has none."""
    n = system.n_x
    s = jnp.concatenate([jnp.asarray(system.x0, float), jnp.zeros(1)])
    P = jnp.zeros((n + 1, n + 1)).at[:n, :n].set(jnp.asarray(system.P0, float))
    faulty = np.arange(modes) > 0
    P = jnp.broadcast_to(P, (modes, n + 1, n + 1)).at[:, n, n].set(jnp.where(faulty, theta_var, 0.0))
    return Bank(jnp.broadcast_to(s, (modes, n + 1)), P, jnp.asarray(probability, float))


def filtered(
    system: Any, d: Array, s: Array, P: Array, walk: Array, u: Array, y: Array, valid: Array, dt: Array
) -> Updated:
    """One step of every mode's filter from s (M, n_x + 1) and P. d (M, n_theta); walk: variance that a loss gains per second."""
    n = system.n_x
    Q, R = system.Q(dt), system.R(u)

    def one(d, s, P, walk):
        along = _Along(system, d)
        x, F, Phi = linearise.transition(along, s[:n], u, s[n:], dt)
        A = jnp.concatenate([jnp.concatenate([F, Phi], axis=1), jnp.asarray(np.eye(n + 1)[n:])])
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


def posterior(predicted: Array, fit: Array) -> Array:
    """(M,) probabilities from those predicted and the log-likelihoods; no underflow, whatever the size of the latter."""
    weight = predicted * jnp.exp(fit - fit.max())
    return weight / weight.sum()


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
