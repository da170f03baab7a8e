"""Adaptive Thau observer: a copy of the plant with a gain from a Lyapunov equation, and losses adapted by the observer's error.

    x- = f(x, u, theta),   e = y - h(x-, u, theta),   x = x- + L e
    theta = theta + dt (gamma G' P C^+ e + k D' e_f - leak theta)                G = d(dx/dt)/dtheta, e_f: of outputs that only theta moves
    P = mu^2 F^-T P F^-1 + C' W C,   L = P^-1 C' W,   mu = exp(-rate dt)

P solves the Lyapunov equation of Thau's observer, A' P + P A + 2 rate P = C' W C, for a step of dt, once, at x0 and u_nominal. With it
V = e' P e falls by mu^2 in every step of the linear part: V+ = mu^4 e' F' M P^-1 M F e with M = F^-T P F^-1 and P >= mu^2 M. Thau's
condition: the nonlinear rest may have a Lipschitz constant (in the norm of P) up to `lipschitz`. W evens the measurements out: one
over the square of what losses do to each within 1 / rate.
Source: Thau, Observing the state of non-linear dynamic systems, Int. J. Control 17 (1973) 471-479; for multirotors Freddi, Longhi and
Monteriu, A diagnostic Thau observer for a class of unmanned vehicles, J. Intelligent and Robotic Systems 67 (2012) 61-73; Cen, Noura,
Susilo and Al Younes, Robust fault diagnosis for quadrotor UAVs using adaptive Thau observer, ibid. 73 (2014) 573-588.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Estimate
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import bounded, linearise, measured_regression, plant
from rotorwatch_lab.maths.small import symmetric

DOUBLINGS = 14  # of the Lyapunov series: 2^14 terms
TINY = 1e-12


class Carry(namedtuple("Carry", "s P")):
    """s = [x; theta] (n_x + n_theta,), and the covariance P of its error."""


class Thau:
    """Adaptive Thau observer on any plant whose states are all measured."""

    name = "thau"
    not_kalman = "its gain is a Lyapunov equation's with a rate that was asked for, and does not follow the noise"

    def __init__(self, system, dt: float, *, rate=12.0, bandwidth=4.0, direct_rate=1.5, leak=0.02, u_nominal=None, theta_sd=0.3, walk=0.05):
        """dt: s. rate: at which the observer's error falls [1/s]; bandwidth: of the adaptation [rad/s]; direct_rate: speed at which
        outputs that only theta moves (the accelerometer) adapt it [1/s]; leak: at which losses fall back to 0 where nothing holds them
        [1/s]. u_nominal (n_u,): input of the design (default: hover). theta_sd: of a loss at the start, walk: of a loss in a
        second; both for the covariance only. Raises ConfigError for wrong values, plants with unmeasured states, and a rate that is
        slower than the plant itself."""
        self.system, self.dt = system, measured_regression.check("The Thau observer", system, dt)
        self.rate = checks.positive("rate", rate)
        bandwidth = checks.positive("bandwidth", bandwidth)
        checks.between("bandwidth times dt", bandwidth * dt, 0.0, 1.0)
        checks.between("direct_rate", direct_rate, 0.0, 1.0 / dt)
        self.leak = checks.between("leak", leak, 0.0, 1.0 / dt)
        self.theta_sd, self.walk = checks.positive("theta_sd", theta_sd), checks.positive("walk", walk)
        self._design(bounded.nominal_input(system, u_nominal), bandwidth, direct_rate)

    def init(self) -> Carry:
        """The plant's start, no loss."""
        return Carry(*plant.start(self.system, self.theta_sd**2 * jnp.eye(self.system.n_theta)))

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """Predict over dt with input u (n_u,), then correct with y (n_y,) where valid."""
        system, n, k = self.system, self.system.n_x, self.system.n_theta
        dt = self.dt if dt is None else dt
        theta = carry.s[n:]
        x, F, Phi = linearise.transition(system, carry.s[:n], u, theta, dt)
        y_, C, D = linearise.measurement(system, x, u, theta)
        e, R = jnp.where(valid, y - y_, 0.0), system.R(u)
        adapt = self.gamma * Phi.T @ self.weight + dt * self.k_f * D.T * self.direct
        K = jnp.where(valid, jnp.concatenate([self.L, adapt]), 0.0)
        s = jnp.concatenate([x, theta]) + K @ e
        s = s.at[n:].add(jnp.where(valid.any(), -dt * self.leak * theta, 0.0))

        # The error of (x, theta) under these gains, whatever they are; that losses leak is left out.
        A = linearise.augmented(F, Phi)
        H = jnp.concatenate([C, D], axis=1)
        P = A @ carry.P @ A.T
        P = P.at[:n, :n].add(system.Q(dt)).at[n:, n:].add(self.walk**2 * dt * np.eye(k))
        S = H @ P @ H.T + jnp.diag(R)
        P = linearise.joseph(P, K, H, R)
        return Carry(s, P), Estimate(s[:n], P[:n, :n], s[n:], P[n:, n:], e, symmetric(S), linearise.status(valid))

    def _design(self, u, bandwidth, direct_rate) -> None:
        """L (n_x, n_y); weight (n_x, n_y) = P C^+; gamma, k_f; direct (n_y,): 1 for outputs that only theta moves; lipschitz."""
        system, x0, healthy = self.system, jnp.asarray(self.system.x0, float), jnp.zeros(self.system.n_theta)
        u = jnp.asarray(u, float)
        F, Phi = linearise.transition(system, x0, u, healthy, self.dt)[1:]
        C, D = linearise.measurement(system, x0, u, healthy)[1:]
        self.direct = jnp.where((C * C).sum(axis=1) < TINY, 1.0, 0.0)
        size = ((C @ linearise.transition(system, x0, u, healthy, 1.0 / self.rate).by_theta * self.rate) ** 2).sum(axis=1)
        W = jnp.where(size > TINY, 1.0 / jnp.maximum(size, TINY), 1.0 / system.R(u)) * (1.0 - self.direct)
        back = measured_regression.left_inverse(F) * jnp.exp(-self.rate * self.dt)  # mu F^-1
        if checks.concrete(back) and np.abs(np.linalg.eigvals(np.asarray(back))).max() >= 1.0:
            raise ConfigError(f"rate = {self.rate:g} /s is slower than the plant {system.name} itself; choose a larger one.")
        P = (C.T * W) @ C
        for _ in range(DOUBLINGS):
            P, back = P + back.T @ P @ back, back @ back
        P = symmetric(P)
        factor = jnp.linalg.cholesky(P), True
        self.P, self.L = P, jax.scipy.linalg.cho_solve(factor, C.T * W)
        # The fastest loss answers with the bandwidth: s^2 + rate s + gamma G' P G, per second.
        G = Phi / self.dt
        self.gamma = bandwidth**2 / jnp.maximum(jnp.max(jnp.sum((G.T @ P) * G.T, axis=1)), TINY)
        self.weight = P @ measured_regression.left_inverse(C) * (1.0 - self.direct)
        self.k_f = direct_rate / jnp.maximum(jnp.sum((D * self.direct[:, None]) ** 2), TINY)
        # V falls while the rest is slower than this [1/s].
        self.lipschitz = (jnp.exp(self.rate * self.dt) - 1.0) / self.dt
