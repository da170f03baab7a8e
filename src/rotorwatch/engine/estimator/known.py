"""Measurement rows and residual noise of ticks whose losses are known. For studies only, not part of the method."""

from __future__ import annotations

from rotorwatch.base.compiling.structs import FLAG, REAL, Flags, Reals, local
from rotorwatch.engine.estimator.batch import take
from rotorwatch.engine.estimator.estimator_sizes import STATES
from rotorwatch.engine.estimator.kalman import Branch, Measured
from rotorwatch.engine.estimator.noise import WHITE, Noise
from rotorwatch.engine.estimator.plant import B1, B2, B3, PER_AXIS, THETA, YAW, Inputs, Plant, Rows, dot, entry, rows


def measure(p: Plant, count: int, u: Reals, out: list[Rows]) -> None:
    """Measurement rows of `count` ticks for a state of zeros and hover as mean thrust. u: as in `batch.run`, without the last two numbers
    of each tick."""
    now = Inputs()
    none = local(REAL, STATES)
    for t in range(count):
        take(p, u, t * (p.rotors + 13), now)
        rows(p, now, now.thrust, now.forward, now.right, none, out[t])


def learn(p: Plant, count: int, u: Reals, y: Reals, valid: Flags, flying: Flags, noise: Noise) -> None:
    """Learn the noise of `count` ticks from the residuals of a filter that trusts all commands and motion. y: wrench without the share that
    the known losses take; u as in `measure`; valid: 4 per tick."""
    now = Inputs()
    m = Measured()
    h = Rows()
    b = Branch()
    b.begin(p)
    noise.begin(p)
    share = local(REAL, STATES)
    left = local(REAL, 4)
    trust = local(REAL, 4)
    learns = local(FLAG, 4)
    for r in range(STATES):
        share[r] = 1.0
    for i in range(p.rotors):
        for j in range(i + 1):
            b.P[entry(THETA + i, THETA + j)] = 0.0
    for t in range(count):
        take(p, u, t * (p.rotors + 13), now)
        b.predict(p, noise, 1.0, flying[t])
        rows(p, now, now.thrust, now.forward, now.right, b.s, h)
        for a in range(4):
            m.y[a] = y[4 * t + a]
            m.counts[a] = valid[4 * t + a]
            m.R[a] = noise.v[WHITE][a]
        for i in range(p.rotors):
            m.y[YAW] += h.drag[i]
        for a in range(4):
            x = a * PER_AXIS
            left[a] = m.y[a] - dot(h.h[a], b.s, a, THETA + p.rotors) + b.s[x + B1] + b.s[x + B2] + b.s[x + B3]
            trust[a] = 1.0
            learns[a] = m.counts[a] and flying[t]
        b.update(p, h, m, share)
        noise.step(p, left, learns, trust)
