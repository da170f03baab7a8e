"""Process noise that adapts to the innovations by the MIT rule, for the adaptive EKF and UKF.

Gradient descent on V = tr(dS^2), dS = mean of the last e e' minus S, the covariance the filter expects:

    q_i <- q_i exp(2 eta dt (H' dS H)_ii / (H' S H)_ii)

in logarithms, so that q stays positive, and divided by what the filter expects, so that eta [1/s] means the same for
every state. States that no innovation shows directly keep their q. Source: the adaptation compared with in Qi, Song,
Dai, Han and Wang 2015 (doi:10.5772/60854); one of the two adaptive schemes for Kalman filters that Wu, Qi, Song, Qi and
Han 2015 (doi:10.1515/amcs-2015-0013) name is the MIT rule; its form is reconstructed. It matches the mean SQUARE of
innovations: noise with a mean, or coloured, is not covered.
"""

from __future__ import annotations

from collections import namedtuple
from typing import NamedTuple

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.core import Array

LARGEST_STEP, SMALLEST, LARGEST = 0.5, 1e-4, 1e4


class Adaptation(NamedTuple):
    """How fast (eta, 1/s), and over how many measured steps innovations are averaged: before there are so many, nothing adapts."""

    eta: float
    window: int


class MitState(namedtuple("MitState", "log_q e seen")):
    """log_q (n,): logarithms of the factors on Q's diagonal; e, seen (window, n_y): innovations of the last steps in
    which anything was measured, and which were (1) or not (0)."""


def adaptation(eta: float, window_s: float, dt: float) -> Adaptation:
    """With a window of so many seconds, in measured steps of dt [s]; one at least. Raises ConfigError for values that make no sense."""
    steps = checks.positive("window_s", window_s) / checks.positive("dt", dt)
    checks.between("window_s / dt", steps, 0, 10_000)
    return Adaptation(checks.positive("eta", eta), max(1, round(steps)))


def init(n: int, n_y: int, adaptation: Adaptation) -> MitState:
    """No innovation seen yet, factors 1."""
    import numpy as np

    return MitState(np.zeros(n), np.zeros((adaptation.window, n_y)), np.zeros((adaptation.window, n_y)))


def scaled(Q: Array, state: MitState) -> Array:
    """Q (n, n) with its diagonal times the factors, correlations kept."""
    root = jnp.exp(0.5 * state.log_q)
    return Q * root * root[:, None]


def adapt(state: MitState, H: Array, S: Array, e: Array, valid: Array, dt, adaptation: Adaptation) -> MitState:
    """After a step with innovation e (n_y,), its expected covariance S, and H (n_y, n) = dy/dz."""
    measured, now = valid.any(), jnp.where(valid, 1.0, 0.0)
    e_all = jnp.where(measured, jnp.concatenate([state.e[1:], jnp.where(valid, e, 0.0)[None]]), state.e)
    seen = jnp.where(measured, jnp.concatenate([state.seen[1:], now[None]]), state.seen)
    count = seen.T @ seen
    dS = jnp.where(count > 0, e_all.T @ e_all / jnp.maximum(count, 1.0) - S, 0.0)
    wanted = (H * (dS @ H)).sum(0)
    expected = (H * (S @ H)).sum(0)
    rate = jnp.where(expected > 0, wanted / jnp.where(expected > 0, expected, 1.0), 0.0)
    full = measured & seen[0].any()  # not from the first few alone
    step = jnp.clip(2 * adaptation.eta * dt * rate, -LARGEST_STEP, LARGEST_STEP) * full
    return MitState(jnp.clip(state.log_q + step, jnp.log(SMALLEST), jnp.log(LARGEST)), e_all, seen)
