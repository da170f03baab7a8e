"""Zhang's adaptive Kalman filter: states by Kalman's filter, losses by recursive least squares with forgetting.

    P- = F P F' + Q,   Sigma = C P- C' + R,   K = P- C' Sigma^-1,   P = (I - K C) P-
    Upsilon- = F Upsilon + Phi,   Omega = C Upsilon- + D,   Upsilon = Upsilon- - K Omega
    Gamma = S Omega' (lambda Sigma + Omega S Omega')^-1,   S+ = (S - Gamma Omega S) / lambda
    dtheta = Gamma e,   x = x- + K e + Upsilon dtheta

Upsilon (n_x, p) is the sensitivity of the filter's state to theta, Omega (m, p) that of its innovation, S the covariance of
theta. Source: Zhang, Adaptive Kalman filter for actuator fault diagnosis, Automatica 93 (2018), in the form of Rot, Hasan and
Manoonpong (2020), Table 1; D, the direct feedthrough of theta to y, is added here. With lambda = 1 this is the Kalman filter
of the state augmented by a constant theta (Friedland's separation); with lambda < 1 theta minimises the squared whitened
innovations weighted by lambda^age.

lambda = exp(-dt / memory_s): the memory is a time, and the same for any length of step. The sources give lambda for a step of 1 ms. With
more losses than measurements it lasts LEAST_SAMPLES steps at least.

What is not excited is forgotten without bound: S grows as lambda^-k. Here S is kept below s_max: for what is forgotten the information
1 / s_max comes back, S^-1 becomes lambda S^-1 + (1 - lambda) / s_max I, which leaves what is well measured as it was (exponential
forgetting and resetting: Salgado, Goodwin and Middleton, Int. J. Control 47, 1988). Two half steps forget as much as a whole one.
"""

from __future__ import annotations

from collections import namedtuple
from typing import NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.core import Estimate
from rotorwatch_lab.maths import linearise, plant
from rotorwatch_lab.maths.small import definite_solve, symmetric

MEMORY_S = -1e-3 / float(np.log(0.995))
"""s: the factor 0.995 of Rot et al. in their steps of 1 ms."""
LEAST_SAMPLES = 20
"""A measurement tells of as many losses as it has numbers; the others show only while inputs vary. On a hexarotor at 20 Hz AXKF's losses
swing by 1.9 with the 4 samples of MEMORY_S, by 0.3 with 20 and more (docs/methods/axkf.md)."""
ROUNDING = 2e-15  # of the largest variance


class State(namedtuple("State", "x P theta S Upsilon")):
    """x (n,) and P (n, n): state, and its covariance were theta known. theta (p,), its covariance S. Upsilon (n, p)."""


class Memory(NamedTuple):
    """seconds: after which a measurement counts 1/e, inf to forget nothing. s_max: bound of S, inf without."""

    seconds: float
    s_max: float


class Zhang:
    """Base of the methods that use this recursion. A method sets `name` and chooses the point of linearisation."""

    name = ""
    not_kalman = (
        "it forgets: measurements count the less for the losses the older they are; with memory_s=None it is the augmented "
        "Kalman filter of constant losses"
    )

    def __init__(self, system, dt: float, *, memory_s: float | None = MEMORY_S, theta_var=0.01, s_max: float | None = 1.0):
        """dt: s. memory_s: time after which a measurement counts 1/e for the losses [s], None to forget nothing, and LEAST_SAMPLES
        steps at least where losses outnumber measurements; theta_var: variance of the losses at the start, a number or one per theta;
        s_max: bound of that variance, None for none. Raises ConfigError for wrong values."""
        self.system, self.dt = plant.checked("The adaptive Kalman filter", system, dt), dt
        least = LEAST_SAMPLES * dt if system.n_theta > system.n_y else 0.0
        larger = np.maximum if checks.concrete((memory_s,)) else jnp.maximum
        self.memory_s = np.inf if memory_s is None else larger(checks.positive("memory_s", memory_s), least)
        self.theta_var = linearise.variances("theta_var", theta_var, system.n_theta)
        self.s_max = np.inf if s_max is None else checks.positive("s_max", s_max)
        if s_max is not None and checks.concrete((theta_var, s_max)):
            checks.between("theta_var", theta_var, 0.0, s_max)

    def start(self) -> State:
        """The plant's start, no loss."""
        n, p = self.system.n_x, self.system.n_theta
        x, P = jnp.asarray(self.system.x0, float), jnp.asarray(self.system.P0, float)
        return State(x, P, jnp.zeros(p), jnp.diag(self.theta_var), jnp.zeros((n, p)))

    def recursion(self, state: State, x, f: linearise.Linear, e, h: linearise.Linear, u, valid, dt) -> tuple[State, Estimate]:
        """`step` with this plant's noise."""
        dt = self.dt if dt is None else dt
        memory = Memory(self.memory_s, self.s_max)
        return step(state, x, f, e, h, self.system.Q(dt), self.system.R(u), valid, memory, dt)


def forget(S, memory: Memory, dt):
    """S after dt seconds of which nothing is measured: S / lambda, kept below s_max."""
    lam, gone = jnp.exp(-dt / memory.seconds), -jnp.expm1(-dt / memory.seconds)
    # A direction rounded to below zero would be blown up by forgetting like any other.
    unit = np.eye(S.shape[0])
    S = S + ROUNDING * S.diagonal().max() * unit
    return symmetric(definite_solve(lam * unit + gone / memory.s_max * S, S))


def step(state: State, x, f: linearise.Linear, e, h: linearise.Linear, Q, R, valid, memory: Memory, dt) -> tuple[State, Estimate]:
    """Update from the prediction x (n,) at the old theta, dt seconds later, with e (m,): y minus its prediction.

    f, h: the step, with F (n, n) and Phi (n, p), and the measurement, with C (m, n) and D (m, p). R (m,): variances. The equations
    above, one measurement after the other, because R is diagonal: nothing is inverted.
    """
    (_, F, Phi), (_, C, D) = f, h
    e = jnp.where(valid, e, 0.0)
    n, p = len(x), len(state.theta)
    P = F @ state.P @ F.T + Q
    Upsilon = F @ state.Upsilon + Phi
    S = forget(state.S, memory, dt)
    Omega = C @ Upsilon + D
    S_e = C @ P @ C.T + Omega @ S @ Omega.T + jnp.diag(R)
    # Side by side, because one measurement changes them alike: [P, Upsilon, -dx] by K [c P, omega, r], [S, -dtheta] likewise.
    state_side = jnp.concatenate([P, Upsilon, jnp.zeros((n, 1))], axis=1)
    theta_side = jnp.concatenate([S, jnp.zeros((p, 1))], axis=1)
    direct = jnp.concatenate([jnp.zeros((len(e), n)), D, e[:, None]], axis=1)
    for i in range(len(e)):
        row = C[i] @ state_side + direct[i]  # P c, omega, and the innovation r that earlier ones leave
        sigma = C[i] @ row[:n] + R[i]
        state_side = state_side - _outer(row[:n] * jnp.where(valid[i], 1.0 / sigma, 0.0), row)
        omega = row[n : n + p]
        column = omega @ theta_side + jnp.concatenate([jnp.zeros(p), row[-1:]])
        variance = sigma + omega @ column[:p]
        theta_side = theta_side - _outer(column[:p] * jnp.where(valid[i], 1.0 / variance, 0.0), column)
    P, Upsilon, dx = state_side[:, :n], state_side[:, n : n + p], -state_side[:, -1]
    S, dtheta = theta_side[:, :p], -theta_side[:, -1]
    P, S = 0.5 * (P + P.T), 0.5 * (S + S.T)
    x, theta = x + dx + Upsilon @ dtheta, state.theta + dtheta
    x_cov = P + Upsilon @ S @ Upsilon.T
    estimate = Estimate(x, 0.5 * (x_cov + x_cov.T), theta, S, e, 0.5 * (S_e + S_e.T), linearise.status(valid))
    return State(x, P, theta, S, Upsilon), estimate


def _outer(a, b):
    return a[:, None] * b[None, :]
