"""Three-stage Kalman filter: one filter of the state, one of disturbances, one of losses, and what couples them.

    x+ = f(x, u, theta) + dt g o d,   d+ = a d + noise,   theta+ = theta + walk,   y = h(x, u, theta)         a = exp(-dt / disturbance_s)
    P = T diag(P_x, P_d, P_theta) T',   T = [I V12 V13; 0 I V23; 0 0 I]

    prediction   b1 = F V13 + G V23 + Phi,   b2 = a V23,   c = F V12 + G                                       G = dt diag(g)
                 P_theta- = P_theta + walk dt      U13 = b1 P_theta P_theta-^-1       U23 = b2 P_theta P_theta-^-1
                 P_d- = a^2 P_d + Q_d + b2 P_theta (b2 - U23)'      U12 = [a c P_d + b1 P_theta (b2 - U23)'] P_d-^-1
                 P_x- = F P_x F' + Q + c P_d c' + b1 P_theta (b1 - U13)' - U12 P_d- U12'
    measurement  N2 = C U12,  N3 = C U13 + D;   S1 = C P_x- C' + R,  S2 = S1 + N2 P_d- N2',  S3 = S2 + N3 P_theta- N3'
                 K1 = P_x- C' S1^-1,   K2 = P_d- N2' S2^-1,   K3 = P_theta- N3' S3^-1
                 V12 = U12 - K1 N2,    V23 = U23 - K2 N3,     V13 = U13 - K1 N3 - V12 K2 N3
                 theta += K3 e,   d += (K2 + V23 K3) e,   x += (K1 + V12 K2 + V13 K3) e

g [1/s times the state's unit] is what a full loss of one rotor does to each state, so that d counts in losses: gusts and shifting
loads that push like a rotor but come and go. Source: Friedland, Treatment of bias in recursive filtering, IEEE Trans. Automatic
Control 14 (1969) 359-367; Chen and Hsieh, Optimal multistage Kalman estimators, IEEE Trans. Automatic Control 45 (2000)
2182-2188, for three stages. Like theirs it is the augmented Kalman filter, of (x, d, theta), taken apart.
"""

from __future__ import annotations

from collections import namedtuple
from typing import NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jax, jnp
from rotorwatch.core import Array, Estimate
from rotorwatch_lab.maths import bounded, linearise, plant, unscented
from rotorwatch_lab.maths.small import symmetric


class Carry(namedtuple("Carry", "x d theta P_x P_d P_theta V12 V13 V23")):
    """x, d (n_x,), theta (n_theta,): fused estimates. P_x, P_d, P_theta: covariances of the stages. V12 (n_x, n_x), V13 and V23
    (n_x, n_theta): how the state follows the disturbance and the losses, and the disturbance the losses."""


class Output(NamedTuple):
    """estimate; disturbance (n_x,) in full losses of one rotor, and its covariance."""

    estimate: Estimate
    disturbance: Array
    disturbance_cov: Array


class ThreeStage:
    """Three-stage Kalman filter on any plant that can be differentiated."""

    name = "three_stage"
    not_kalman = "it estimates a disturbance beside the losses; with disturbance_share=0 it is the augmented Kalman filter"

    def __init__(self, system, dt: float, *, theta_walk=1e-3, theta_var=0.01, disturbance_share=0.05, disturbance_s=1.0, u_nominal=None):
        """dt: s. theta_walk: variance that a loss gains per second [1/s]; theta_var: its variance at the start; both a number or one
        per theta. disturbance_share: standard deviation of the disturbance, as a share of what the full loss of one rotor does at
        u_nominal (n_u,; default: hover); disturbance_s: its correlation time [s]. Raises ConfigError for wrong values."""
        self.system, self.dt = plant.checked("The three-stage Kalman filter", system, dt), dt
        self.theta_walk = linearise.variances("theta_walk", theta_walk, system.n_theta)
        self.theta_var = linearise.variances("theta_var", theta_var, system.n_theta)
        checks.shape("P0", system.P0, system.n_x, system.n_x)
        self.share = checks.between("disturbance_share", disturbance_share, 0.0, np.inf)
        self.correlation_s = checks.positive("disturbance_s", disturbance_s)
        self.g = self._push(bounded.nominal_input(system, u_nominal))

    def init(self) -> Carry:
        """The plant's start, no loss, no disturbance known."""
        n, k = self.system.n_x, self.system.n_theta
        cross = jnp.zeros((n, k))
        return Carry(
            x=jnp.asarray(self.system.x0, float),
            d=jnp.zeros(n),
            theta=jnp.zeros(k),
            P_x=jnp.asarray(self.system.P0, float),
            P_d=self.share**2 * jnp.eye(n),
            P_theta=jnp.diag(self.theta_var),
            V12=jnp.zeros((n, n)),
            V13=cross,
            V23=cross,
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Output]:
        """Predict over dt with input u (n_u,), then update with y (n_y,) where valid."""
        system, c0 = self.system, carry
        dt = self.dt if dt is None else dt
        G, a = dt * jnp.diag(self.g), jnp.exp(-dt / self.correlation_s)
        x, F, Phi = linearise.transition(system, c0.x, u, c0.theta, dt)
        x, d = x + G @ c0.d, a * c0.d

        b1, b2, c = F @ c0.V13 + G @ c0.V23 + Phi, a * c0.V23, F @ c0.V12 + G
        P_theta = c0.P_theta + dt * jnp.diag(self.theta_walk)
        both = jnp.concatenate([b1, b2]) @ c0.P_theta
        U = jax.scipy.linalg.cho_solve((unscented.root(P_theta), True), both.T).T
        U13, U23 = U[: len(x)], U[len(x) :]
        b1_P, b2_P = both[: len(x)], both[len(x) :]
        P_d = a * a * c0.P_d + (1.0 - a * a) * self.share**2 * np.eye(len(x)) + b2_P @ (b2 - U23).T
        P_d = symmetric(P_d)
        cross = a * c @ c0.P_d + b1_P @ (b2 - U23).T
        U12 = jax.scipy.linalg.cho_solve((unscented.root(P_d), True), cross.T).T
        P_x = F @ c0.P_x @ F.T + system.Q(dt) + c @ c0.P_d @ c.T + b1_P @ (b1 - U13).T - U12 @ cross.T
        P_x = symmetric(P_x)

        y_, C, D = linearise.measurement(system, x, u, c0.theta)
        e = jnp.where(valid, y - y_, 0.0)
        N2, N3, R = C @ U12, C @ U13 + D, jnp.diag(system.R(u))
        S1 = C @ P_x @ C.T + R
        S2 = S1 + N2 @ P_d @ N2.T
        S3 = symmetric(S2 + N3 @ P_theta @ N3.T)
        K1, K2, K3 = (unscented.gain(P @ N.T, S, valid) for P, N, S in ((P_x, C, S1), (P_d, N2, S2), (P_theta, N3, S3)))
        V12, V23 = U12 - K1 @ N2, U23 - K2 @ N3
        V13 = U13 - K1 @ N3 - V12 @ K2 @ N3
        theta = c0.theta + K3 @ e
        d = d + K2 @ e + V23 @ (K3 @ e)
        x = x + K1 @ e + V12 @ (K2 @ e) + V13 @ (K3 @ e)
        P_x, P_d, P_theta = _joseph(P_x, K1, C, R), _joseph(P_d, K2, N2, S1), _joseph(P_theta, K3, N3, S2)
        x_cov = symmetric(P_x + V12 @ P_d @ V12.T + V13 @ P_theta @ V13.T)
        d_cov = symmetric(P_d + V23 @ P_theta @ V23.T)
        out = Estimate(x, x_cov, theta, P_theta, e, S3, linearise.status(valid))
        return Carry(x, d, theta, P_x, P_d, P_theta, V12, V13, V23), Output(out, d, d_cov)

    def _push(self, u):
        """g (n_x,): the largest rate of change that the full loss of one theta causes at x0 and u (n_u,)."""
        system = self.system
        x0, u = jnp.asarray(system.x0, float), jnp.asarray(u, float)

        slope = jax.jacfwd(lambda theta: linearise.rate(system, x0, u, theta))
        return jnp.abs(slope(jnp.zeros(system.n_theta))).max(axis=1)


def _joseph(P, K, H, R):
    """(I - K H) P (I - K H)' + K R K', symmetric."""
    rest = np.eye(P.shape[0]) - K @ H
    return symmetric(rest @ P @ rest.T + K @ R @ K.T)
