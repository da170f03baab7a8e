"""The Lyapunov adaptation law of Niermeyer, Pak and Lohmann 2017 for any plant whose states are all measured.

With the measured state x_m, w = x_hat - x_m, l = theta_hat - theta, G = d(dx/dt)/dtheta, and for outputs that the states do
not move (the accelerometer) their error f~ = y_hat - y and D = dh/dtheta:

    dx_hat/dt     = dx/dt(x_m, u, theta_hat) - k_w w
    dtheta_hat/dt = Proj{ -Gamma (G' M w + k_f D' f~) }
    V = w' M w / 2 + l' Gamma^-1 l / 2    =>    dV/dt = -k_w w' M w - k_f f~' f~      while dx/dt is affine in theta

On the rate dynamics G = -J^-1 B_tau diag(u) and M = P J: the paper's law, written for losses instead of effectiveness.
M is diagonal and evens out the axes: at the nominal input each answers to theta with the same speed, which is `bandwidth`.
"""

from __future__ import annotations

from collections import namedtuple
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Estimate
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import bounded, linearise, plant

TINY = 1e-12


class Terms(namedtuple("Terms", "x A G y C D C_left direct")):
    """The plant at one point: x- (n_x,), A = df/dx, G = df/dtheta per second, C = dh/dx, D = dh/dtheta, y- and C's left inverse."""


@dataclass(eq=False, repr=False)
class Adaptation:
    """Base of the methods that use this law. A method sets `name` and `not_kalman`.

    rate: state correction k_w [1/s]. bandwidth: of the adaptation, sqrt of Gamma [rad/s]. direct_rate: speed at which outputs that only
    theta moves (the accelerometer) adapt it [1/s]. bounds: least and largest loss. hold: share of u_nominal below which a
    rotor's loss rests. u_nominal (n_u,): input the gains are evened out for (default: hover). theta_sd: of a loss at the
    start; walk: of a loss in a second; both for the covariance only. Raises ConfigError for plants with unmeasured states.
    """

    system: Any
    dt: Any
    _: KW_ONLY
    rate: Any = 12.0
    bandwidth: Any = 4.0
    direct_rate: Any = 1.5
    bounds: Any = (-0.02, 1.0)
    hold: Any = 0.22
    u_nominal: Any = None
    theta_sd: Any = 0.3
    walk: Any = 0.05

    name = not_kalman = ""

    def __post_init__(self):
        self.law = Law(self)
        checks.positive("theta_sd", self.theta_sd)
        checks.positive("walk", self.walk)


class Law:
    """Gains of the law for one plant. Raises ConfigError where a state is not measured, or theta never moves anything."""

    def __init__(self, method: Adaptation):
        self.system, dt, system = plant.checked(method.name, method.system, method.dt), method.dt, method.system
        checks.positive("rate", method.rate)
        checks.positive("bandwidth", method.bandwidth)
        checks.between("direct_rate", method.direct_rate, 0.0, 1.0 / dt)
        checks.between("bandwidth times dt", method.bandwidth * dt, 0.0, 1.0)
        checks.finite("hold", method.hold)
        self.rate, self.gamma, self.hold = method.rate, method.bandwidth**2, method.hold
        self.bounds = bounded.of_losses(system, method.bounds)
        self.u_nominal = bounded.nominal_input(system, method.u_nominal)
        x0, u = jnp.asarray(system.x0, float), jnp.asarray(self.u_nominal, float)
        at = self.terms(x0, u, jnp.zeros(system.n_theta), dt)
        if checks.concrete(at.C):
            head = f"{method.name} is not defined for the plant {checks.plant_name(system)}: "
            if np.linalg.matrix_rank(np.asarray(at.C)) < system.n_x:
                why = "it needs every state measured, because the law compares states with their measurements."
                raise ConfigError(head + why)
            if not np.abs(at.G).max() > 0:
                raise ConfigError(head + "its theta does not move the states at u_nominal.")
        size = jnp.sum(at.G**2, axis=1)
        self.M = jnp.where(size > TINY, 1.0 / jnp.maximum(size, TINY), 1.0)
        self.k_f = method.direct_rate / (self.gamma * jnp.maximum(jnp.sum((at.D * at.direct[:, None]) ** 2), TINY))

    def terms(self, x, u, theta, dt) -> Terms:
        """f, h and their Jacobians for a step of dt from x."""
        f, h, n = self.system.f, self.system.h, self.system.n_x
        both = jnp.concatenate([x, theta])
        x_next, move = linearise.once(lambda s: f(s[:n], u, s[n:], dt), both)
        y, look = linearise.once(lambda s: h(s[:n], u, s[n:]), jnp.concatenate([x_next, theta]))
        C, D = look[:, :n], look[:, n:]
        direct = jnp.sum(C * C, axis=1) < TINY
        factor = jnp.linalg.cholesky(C.T @ C + TINY * jnp.eye(n))
        C_left = jax.scipy.linalg.cho_solve((factor, True), C.T)
        return Terms(x_next, move[:, :n], move[:, n:] / dt, y, C, D, C_left, direct)

    def gains(self, at: Terms, u, dt):
        """L_x (n_x, n_y), L_theta (n_theta, n_y): what an innovation moves, before the projection."""
        adapt = at.G.T @ (self.M[:, None] * at.C_left) + self.k_f * at.D.T * at.direct[None, :]
        L_x = (1.0 - jnp.exp(-self.rate * dt)) * at.C_left
        return L_x, dt * self.gamma * adapt * self.moving(u)[:, None]

    def moving(self, u):
        """(n_theta,) 1, or 0 where the rotor's command is too small for its loss to be observable."""
        return bounded.moving(self.system, u, self.hold * self.u_nominal)

    def project(self, theta):
        """theta within the bounds."""
        return jnp.clip(theta, *self.bounds)


def estimate(state: State, e, S, valid) -> Estimate:
    """The state as an estimate, with the innovation e (n_y,) and its covariance S."""
    n = state.x.shape[0]
    return Estimate(state.x, state.P[:n, :n], state.theta, state.P[n:, n:], e, S, linearise.status(valid))


class State(namedtuple("State", "x theta P measured")):
    """x, theta: the estimate. P: covariance of both. measured (n_x,): the state as last measured, predicted where it was not."""


def start(system, theta_sd, x0=None) -> State:
    """The state before the first measurement: nothing lost, give or take theta_sd."""
    x = jnp.asarray(system.x0 if x0 is None else x0, float)
    n, k = system.n_x, system.n_theta
    P = jnp.zeros((n + k, n + k)).at[:n, :n].set(system.P0).at[n:, n:].set(theta_sd**2 * jnp.eye(k))
    return State(x, jnp.zeros(k), P, x)


def advance(law: Law, state: State, u, y, valid, dt, walk) -> tuple[State, Any, Any, Terms]:
    """Advance the law by one step: (state, innovation (n_y,), its covariance, the plant's terms).

    P is the covariance of this observer's own error, F P F' + Q and then (I - L C) P (I - L C)' + L R L' with the law's gains
    L: what a fixed-gain observer knows. walk: random walk of theta [1 per square root of s].
    """
    system, n = law.system, law.system.n_x
    at = law.terms(state.measured, u, state.theta, dt)
    x_minus = state.x + at.x - state.measured
    y_minus = at.y + at.C @ (x_minus - at.x)
    e = jnp.where(valid, y - y_minus, 0.0)
    L_x, L_theta = law.gains(at, u, dt)
    x = x_minus + L_x @ e
    theta = law.project(state.theta + L_theta @ e)

    k = system.n_theta
    F = jnp.block([[at.A, dt * at.G], [jnp.zeros((k, n)), jnp.eye(k)]])
    Q = jnp.concatenate([jnp.zeros(n), jnp.full(k, walk**2 * dt)])
    P = F @ state.P @ F.T + jnp.diag(Q) + jnp.pad(system.Q(dt), (0, k))
    H = jnp.concatenate([at.C, at.D], axis=1)
    R = system.R(u)
    L = jnp.concatenate([L_x, L_theta]) * valid[None, :]
    S = H @ P @ H.T + jnp.diag(R)
    P = linearise.joseph(P, L, H, R)
    measured = x + at.C_left @ jnp.where(valid, y - at.y - at.C @ (x - at.x), 0.0)
    return State(x, theta, P, measured), e, 0.5 * (S + S.T), at
