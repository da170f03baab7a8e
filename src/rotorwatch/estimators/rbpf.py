"""Rao-Blackwellised particle filter: particles draw which rotor is weak and since when; each carries a Kalman filter of state and loss.

    draw     mode i from q(i | j): stay, or with the probability `jump` any other mode; then a loss of N(0, theta_var)
    filter   the extended Kalman filter of [x; l] in that mode, which gives Lambda
    weigh    w = w p_ji / q_ji Lambda, over their sum                          p_ji: the Markov chain, as in imm
    resample where 1 / sum w^2 < N / 2: systematically, at (k + U) / N of the cumulated weights

Random numbers come from a counter in the carry (`maths/counter_random.py`), so that a run is the same wherever it runs. Modes and their
filters: `maths/multiple_model.py`. Where nothing is measured, no particle changes its mode.
Source: Doucet, de Freitas, Murphy and Russell, Rao-Blackwellised particle filtering for dynamic Bayesian networks, Proc. UAI 2000,
176-183; de Freitas, Rao-Blackwellised particle filtering for fault diagnosis, IEEE Aerospace Conference 2002; Kitagawa, Monte Carlo
filter and smoother, J. Computational and Graphical Statistics 5 (1996) 1-25, for systematic resampling.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base import checks
from rotorwatch.base.backend import jnp
from rotorwatch.core import Array, Estimate
from rotorwatch.maths import counter_random, multiple_model


class Carry(NamedTuple):
    """mode (N,) int32; s (N, n_x + 1) and P (N, n_x + 1, n_x + 1): state and loss; weight (N,). counter: int32, of random numbers."""

    mode: Array
    s: Array
    P: Array
    weight: Array
    counter: Array


class Output(NamedTuple):
    """estimate: of all particles together. probability (M,): of each mode. effective: 1 / sum w^2, before any resampling."""

    estimate: Estimate
    probability: Array
    effective: Array


class RBPF(multiple_model.MultipleModel):
    """Rao-Blackwellised particle filter on any plant that can be differentiated."""

    name, called = "rbpf", "The Rao-Blackwellised particle filter"
    not_kalman = "it draws which rotor is weak, one at a time, and weighs the filters of what was drawn"

    def __init__(
        self,
        system,
        dt: float,
        *,
        particles: int = 100,
        jump=0.1,
        theta_walk=1e-3,
        theta_var=0.1,
        healthy_s=100.0,
        weak_s=1000.0,
        common: bool = True,
        seed: int = 0,
    ):
        """dt: s. particles: N. jump: share of particles that try another mode in a step. theta_walk: variance that the loss of a
        faulty mode gains per second [1/s]; theta_var: variance of a loss that has just begun. healthy_s, weak_s: mean time for which
        the vehicle stays healthy, and a rotor weak [s]. common: one mode more, in which all rotors lose alike. seed: of the random
        numbers, a whole number. Raises ConfigError for wrong values."""
        super().__init__(system, dt, theta_walk, theta_var, common)
        self.N = checks.whole("particles", particles, 2, 2**30 - 1)
        self.seed = checks.whole("seed", seed, 0, 2**30 - 1)
        self.jump = checks.between("jump", checks.positive("jump", jump), 0.0, 0.9)
        self.stay_s = multiple_model.stay(len(self.directions), healthy_s, weak_s)

    def init(self) -> Carry:
        """The plant's start, healthy for certain."""
        bank = multiple_model.start(self.system, 1, self.theta_var, np.ones(1))
        s, P = jnp.repeat(bank.s, self.N, axis=0), jnp.repeat(bank.P, self.N, axis=0)
        return Carry(
            jnp.zeros(self.N, jnp.int32), s, P, jnp.full(self.N, 1.0 / self.N), jnp.int32(self.seed * 65537 % 2**30)
        )

    def step(self, carry: Carry, u, y, valid, dt=None) -> tuple[Carry, Output]:
        """Draw, predict over dt with input u (n_u,), weigh by y (n_y,) where valid, and resample where few count."""
        dt = self.dt if dt is None else dt
        measured = valid.any()
        random = counter_random.uniform(carry.counter, self.N + 1)
        mode, s, P, share = self._drawn(carry, random[: self.N], measured, dt)
        d = self._one_hot(mode) @ self.directions
        predicted = carry.weight * share
        predicted = predicted / predicted.sum()
        new = multiple_model.filtered(self.system, d, s, P, self.theta_walk, u, y, valid, dt)
        weight = jnp.where(measured, multiple_model.posterior(predicted, new.fit), carry.weight)
        out = multiple_model.combined(d, new, predicted, weight, valid)
        effective = 1.0 / (weight * weight).sum()
        few = measured & (effective < 0.5 * self.N)
        place = (np.arange(self.N) + random[self.N]) / self.N
        # As many as have less cumulated weight than the place; the last place may exceed the sum by rounding.
        chosen = (jnp.cumsum(weight)[None, :] < place[:, None]).sum(axis=1)
        chosen = jnp.where(few, jnp.minimum(chosen, self.N - 1), np.arange(self.N)).astype(jnp.int32)
        weight_next = jnp.where(few, 1.0 / self.N, weight)
        counter = (carry.counter + measured.astype(jnp.int32)) % np.int32(2**30)
        probability = weight @ self._one_hot(mode)
        after = Carry(mode[chosen], new.s[chosen], new.P[chosen], weight_next, counter.astype(jnp.int32))
        return after, Output(out.estimate, probability, effective)

    def _drawn(self, carry: Carry, random, measured, dt):
        """mode (N,), s, P of what each particle goes on with, and p / q of what it drew."""
        n, others = self.system.n_x, len(self.directions) - 1
        moves = measured & (random < self.jump)
        # Which of the other modes: they follow the own one in a ring.
        far = 1 + jnp.minimum((random / self.jump * others).astype(jnp.int32), others - 1)
        mode = jnp.where(moves, (carry.mode + far) % np.int32(others + 1), carry.mode).astype(jnp.int32)
        leave = -jnp.expm1(-dt / (self._one_hot(carry.mode) @ self.stay_s))
        share = jnp.where(moves, leave / self.jump, (1.0 - leave) / (1.0 - self.jump))
        share = jnp.where(measured, share, 1.0)
        keep = jnp.where(moves, 0.0, 1.0)[:, None] * (np.arange(n + 1) == n) + (np.arange(n + 1) < n)
        fresh = jnp.where(moves & (mode > 0), self.theta_var, 0.0)
        s = carry.s * keep
        P = carry.P * keep[:, :, None] * keep[:, None, :]
        corner = np.zeros((n + 1, n + 1))
        corner[n, n] = 1.0
        return mode, s, P + fresh[:, None, None] * corner, share

    def _one_hot(self, mode):
        """(N, M) 1.0 where the particle's mode is."""
        return (mode[:, None] == np.arange(len(self.directions), dtype=np.int32)).astype(float)
