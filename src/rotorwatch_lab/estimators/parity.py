"""Parity space: combinations of a window's measurements that no state can move; what moves them is a loss, isolated by least squares.

    Y = O x_0 + Y_u + Gamma theta + noise       over a window of N steps; O = [C F; C F^2; ..; C F^N], x_0 unknown
    V O = 0,   V Sigma V' = I                   Sigma: covariance of the noise, R I + what Q does on the way
    r = V (Y - Y_u),   A = V Gamma;             theta = (A' A + I / theta_var)^-1 A' r

Y_u is what the inputs alone do to the plant linearised at x0 and u_nominal, from a state of 0, and Gamma what each loss then changes;
both are computed along the window, so that theta may multiply inputs that move. F, C, V are made once. Without the prior this is the least
squares fit of the window with an x_0 of which nothing is known.
Source: Chow and Willsky, Analytical redundancy and the design of robust failure detection systems, IEEE Trans. Automatic Control 29
(1984) 603-614; least squares on the parity vector: Gertler, Fault Detection and Diagnosis in Engineering Systems, 1998.
"""

from __future__ import annotations

from collections import namedtuple
from typing import NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch.errors import ConfigError
from rotorwatch_lab.maths import bounded, linearise, plant


class Carry(namedtuple("Carry", "x P push Phi D y count theta theta_cov")):
    """x (n_x,), P (n_x, n_x): a Kalman filter of the state, losses given. push (N, n_x), Phi (N, n_x, n_theta), D (N, n_y, n_theta), y
    (N, n_y): the window, oldest first; count (int32): whole steps in a row, at most N. theta, theta_cov: the losses."""


class Output(NamedTuple):
    """estimate; parity (N n_y - n_x,): the parity vector, of the covariance I while no rotor is weak, 0 while the window has a gap."""

    estimate: Estimate
    parity: Array


class Parity:
    """Parity-space residuals on any plant that is nearly linear about x0."""

    name = "parity"
    not_kalman = "it looks at a window of fixed length only, and at nothing where the window has a gap"

    def __init__(self, system, dt: float, *, window_s=0.4, theta_var=0.1, walk=0.05, u_nominal=None):
        """dt: s. window_s: length of the window [s]. theta_var: variance of the losses before any measurement, a number or one per
        theta. walk: of a loss in a second, by which a theta that is held grows older. u_nominal (n_u,): input of the design (default:
        hover). Raises ConfigError for wrong values, and where the window is too short to see the state."""
        self.system, self.dt = plant.checked("The parity space", system, dt), dt
        self.theta_var = checks.positive("theta_var", linearise.variances("theta_var", theta_var, system.n_theta))
        self.walk = checks.between("walk", walk, 0.0, np.inf)
        self.N = max(2, round(checks.positive("window_s", window_s) / dt))
        self._design(bounded.nominal_input(system, u_nominal))

    def init(self) -> Carry:
        """The plant's start, no loss, an empty window."""
        s, N = self.system, self.N
        return Carry(
            jnp.asarray(s.x0, float),
            jnp.asarray(s.P0, float),
            jnp.zeros((N, s.n_x)),
            jnp.zeros((N, s.n_x, s.n_theta)),
            jnp.zeros((N, s.n_y, s.n_theta)),
            jnp.zeros((N, s.n_y)),
            jnp.int32(0),
            jnp.zeros(s.n_theta),
            jnp.diag(self.theta_var),
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Output]:
        """Advance by dt with input u (n_u,) held over the step and y (n_y,) at its end where valid."""
        system, x0 = self.system, jnp.asarray(self.system.x0, float)
        regular = jnp.array(True) if dt is None else jnp.abs(dt - self.dt) < 1e-6 * self.dt
        dt = self.dt if dt is None else dt

        # The window: what the step and the measurement about x0 have in them besides the deviation from x0.
        none = jnp.zeros(system.n_theta)
        move, look = linearise.transition(system, x0, u, none, dt), linearise.measurement(system, x0, u, none)
        fresh = move.value - x0, move.by_theta, look.by_theta, jnp.where(valid, y - look.value, 0.0)
        before = carry.push, carry.Phi, carry.D, carry.y
        push, Phis, Ds, ys = (jnp.concatenate([old[1:], new[None]]) for old, new in zip(before, fresh, strict=True))
        regular_step = valid.all() & regular
        count = jnp.where(regular_step, jnp.minimum(carry.count + 1, self.N), 0).astype(jnp.int32)
        r, A = self._residual(push, Phis, Ds, ys)
        full = count == self.N
        information = A.T @ A + jnp.diag(1.0 / self.theta_var)
        theta, theta_cov = linearise.posterior(information, A.T @ r)
        older = carry.theta_cov + self.walk**2 * dt * np.eye(len(none))
        theta, theta_cov = jnp.where(full, theta, carry.theta), jnp.where(full, theta_cov, older)

        # The state, beside the losses: a Kalman filter that takes the losses before this step for true but for their covariance.
        x, F, Phi = linearise.transition(system, carry.x, u, carry.theta, dt)
        ahead, C, D = linearise.measurement(system, x, u, carry.theta)
        P = F @ carry.P @ F.T + Phi @ carry.theta_cov @ Phi.T + system.Q(dt)
        e, loss_noise = jnp.where(valid, y - ahead, 0.0), D @ carry.theta_cov @ D.T
        S = C @ P @ C.T + loss_noise + jnp.diag(system.R(u))
        x, P, _ = linearise.update(x, P, C, e, system.R(u) + jnp.diagonal(loss_noise), valid)
        estimate = Estimate(x, P, theta, theta_cov, e, 0.5 * (S + S.T), linearise.status(valid))
        return Carry(x, P, push, Phis, Ds, ys, count, theta, theta_cov), Output(estimate, jnp.where(full, r, 0.0))

    def _residual(self, push, Phi, D, y):
        """r and A = V Gamma of the window: forced responses from a deviation of 0."""

        def go(state, row):
            state = self.F @ state + row[0]
            return state, self.C @ state + row[1]

        n, N = self.system.n_theta, self.N
        rows = (jnp.concatenate([push[:, :, None], Phi], axis=2), jnp.concatenate([jnp.zeros((N, y.shape[1], 1)), D], axis=2))
        forced = jax.lax.scan(go, jnp.zeros((self.system.n_x, n + 1)), rows)[1]
        target = jnp.concatenate([(y - forced[:, :, 0])[:, :, None], forced[:, :, 1:]], axis=2)
        both = self.V @ target.reshape(-1, n + 1)
        return both[:, 0], both[:, 1:]

    def _design(self, u) -> None:
        """F, C at x0 and u, and V (N n_y - n_x, N n_y)."""
        system, N, dt = self.system, self.N, self.dt
        x0, none = jnp.asarray(system.x0, float), jnp.zeros(system.n_theta)
        u = jnp.asarray(u, float)
        design = (
            linearise.transition(system, x0, u, none, dt).by_x,
            linearise.measurement(system, x0, u, none).by_x,
            system.Q(dt),
            system.R(u),
        )
        values = checks.concrete(design)
        xp = np if values else jnp  # with a plant's values by NumPy; where they are a program's parameters, inside it
        F, C, Q, R = (xp.asarray(part) for part in design)
        n_x, n_y = system.n_x, system.n_y
        powers = [xp.eye(n_x)]
        for _ in range(N):
            powers.append(F @ powers[-1])
        seen = xp.concatenate([C @ powers[k] for k in range(1, N + 1)])
        if values and np.linalg.matrix_rank(seen / np.maximum(np.abs(seen).max(axis=0), 1e-300)) < n_x:
            raise ConfigError(
                f"The parity space of the plant {system.name} needs a window in which every state shows; {N} steps are too few, "
                "or a state is never measured."
            )
        none = xp.zeros((n_y, n_x))
        rows = [[C @ powers[k - j] if j <= k else none for j in range(N)] for k in range(N)]
        T = xp.concatenate([xp.concatenate(row, axis=1) for row in rows])  # of each step's process noise
        Sigma = T @ xp.kron(xp.eye(N), Q) @ T.T + xp.diag(xp.tile(R, N))
        V = self._whitener(xp.linalg.cholesky(0.5 * (Sigma + Sigma.T)))
        W = V @ seen
        for k in range(n_x):  # Householder's reflections: what they leave below the first n_x rows of W is zero
            v = xp.where(np.arange(N * n_y) >= k, W[:, k], 0.0)
            size = xp.sqrt(v @ v)
            v = v + xp.where(v[k] < 0.0, -size, size) * np.eye(N * n_y)[k]
            twice = 2.0 / (v @ v)
            W, V = W - twice * xp.outer(v, v @ W), V - twice * xp.outer(v, v @ V)
        self.F, self.C, self.V = F, C, V[n_x:]

    def _whitener(self, root):
        """The inverse of a lower triangular matrix."""
        if isinstance(root, np.ndarray):
            return np.linalg.solve(root, np.eye(len(root)))
        return jax.scipy.linalg.solve_triangular(root, np.eye(root.shape[0]), lower=True)
