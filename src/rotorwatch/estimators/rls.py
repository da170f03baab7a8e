"""Recursive least squares with forgetting: losses as coefficients of the model's equation, what was measured long ago counting less.

    R- = R forgotten,   R = R- + Omega' S^-1 Omega,   theta = theta + R^-1 Omega' S^-1 (z - Omega theta),   P = R^-1

z = Omega theta + noise is the regression of `maths/measured_regression.py`. With lambda = exp(-dt / memory_s), R- is

    exponential   lambda R                                      without excitation P grows as lambda^-k: wind-up
    trace         R / g,  g = min(1 / lambda, trace_max / tr P), at least 1: P stops growing there
    directional   R - (1 - lambda) R r r' R / (r' R r) for each row r of Omega (whitened): only what is measured anew is forgotten

Source: Astrom and Wittenmark, Adaptive Control, 2nd ed. 1995, sections 2.2 and 11.5; directional forgetting of Cao and Schwartz, A
directional forgetting algorithm based on the decomposition of the information matrix, Automatica 36 (2000) 1725-1731.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.core import Array, Estimate
from rotorwatch.maths import linearise, measured_regression
from rotorwatch.maths.small import definite_solve

FORGETTING = ("directional", "trace", "exponential")
LEAST = 1e-12  # of a row's information, below which it has no direction


class Carry(NamedTuple):
    """known: the measured state. theta (n_theta,). R, P (n_theta, n_theta): information on theta, and its inverse."""

    known: measured_regression.Known
    theta: Array
    R: Array
    P: Array


class RLS:
    """Recursive least squares on any plant whose states are all measured."""

    name = "rls"
    not_kalman = "it forgets, and takes the state as measured instead of filtering it"

    def __init__(
        self, system, dt: float, *, memory_s=0.5, theta_var=0.1, forgetting: str = "directional", trace_max: float = 1.0
    ):
        """dt: s. memory_s: time after which a measurement counts 1/e [s]. theta_var: variance of the losses at the start, a number or
        one per theta. forgetting: directional, trace or exponential. trace_max: bound of the trace of P with "trace". Raises
        ConfigError for wrong values, and for plants with unmeasured states."""
        self.system, self.dt = system, measured_regression.check("Recursive least squares", system, dt)
        self.memory_s = checks.positive("memory_s", memory_s)
        self.theta_var = checks.positive("theta_var", linearise.variances("theta_var", theta_var, system.n_theta))
        self.forgetting = checks.one_of("forgetting", forgetting, FORGETTING)
        self.trace_max = checks.positive("trace_max", trace_max)

    def init(self) -> Carry:
        """The plant's start, no loss."""
        known = measured_regression.start(self.system)
        return Carry(known, jnp.zeros(self.system.n_theta), jnp.diag(1.0 / self.theta_var), jnp.diag(self.theta_var))

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Estimate]:
        """One step of dt with input u (n_u,) over it and y (n_y,) at its end where valid."""
        dt = self.dt if dt is None else dt
        before = carry.theta
        found = measured_regression.row(self.system, carry.known, u, y, valid, before, dt)
        z, Omega = measured_regression.whitened(found, valid)
        R = self._forgotten(carry, Omega, jnp.exp(-dt / self.memory_s), valid) + Omega.T @ Omega
        R = 0.5 * (R + R.T)
        P = definite_solve(R, np.eye(len(before)))
        P = jnp.where(valid.any(), 0.5 * (P + P.T), carry.P)
        theta = before + P @ (Omega.T @ (z - Omega @ before))
        known = measured_regression.measured(found, y, valid, theta)
        out = measured_regression.estimate(found, known, valid, carry.P, theta, P)
        return Carry(known, theta, R, P), out

    def _forgotten(self, carry: Carry, Omega, lam, valid):
        """R before the measurement; as it was where nothing is measured."""
        R = carry.R
        if self.forgetting == "directional":
            for r in Omega:
                seen = R @ r
                size = r @ seen
                share = jnp.where(size > LEAST, (1.0 - lam) / jnp.where(size > LEAST, size, 1.0), 0.0)
                R = R - share * seen[:, None] * seen[None, :]
            return R
        growth = 1.0 / lam
        if self.forgetting == "trace":
            growth = jnp.clip(self.trace_max / jnp.trace(carry.P), 1.0, growth)
        return jnp.where(valid.any(), R / growth, R)
