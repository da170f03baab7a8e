"""Measurement rows and residual noise of ticks whose losses are known: for the bounds of `limits`, no part of the default method.

Written in the subset of Python that is compiled (base/compiling/structs.py), on the estimator's own definition of plant, noise and filter.
"""

from __future__ import annotations

import sys

from rotorwatch.base.compiling.running import Definition
from rotorwatch.base.compiling.structs import FLAG, REAL, Flags, local
from rotorwatch.engine.estimator import estimator_sizes, kalman, noise, plant
from rotorwatch.engine.estimator.estimator_sizes import STATES
from rotorwatch.engine.estimator.kalman import Branch, Measured
from rotorwatch.engine.estimator.noise import WHITE, Noise
from rotorwatch.engine.estimator.plant import B1, B2, B3, PER_AXIS, THETA, YAW, Inputs, Plant, Rows, dot, entry, rows, set_plant

FILES = [*(f"engine/estimator/{name}.py" for name in ("plant", "noise", "kalman")), "../rotorwatch_lab/experiments/known_losses.py"]
KNOWN_LOSSES = Definition("known_losses", (plant, noise, kalman, sys.modules[__name__]), estimator_sizes, FILES)


def measure(p: Plant, count: int, ticks: list[Inputs], out: list[Rows]) -> None:
    """Complete the plant; measurement rows of `count` ticks for a state of zeros and hover as mean thrust."""
    none = local(REAL, STATES)
    set_plant(p)
    for t in range(count):
        rows(p, ticks[t], ticks[t].thrust, ticks[t].forward, ticks[t].right, none, out[t])


def learn(p: Plant, count: int, ticks: list[Inputs], flying: Flags, learned: Noise) -> None:
    """Complete the plant; learn the noise of `count` ticks, whose wrench is without what the known losses take, from the residuals of
    a filter that trusts all commands and motion."""
    m = Measured()
    h = Rows()
    b = Branch()
    set_plant(p)
    b.begin(p)
    learned.begin(p)
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
        b.predict(p, learned, 1.0, flying[t])
        rows(p, ticks[t], ticks[t].thrust, ticks[t].forward, ticks[t].right, b.s, h)
        for a in range(4):
            m.y[a] = ticks[t].wrench[a]
            m.counts[a] = ticks[t].valid[a]
            m.R[a] = learned.v[WHITE][a]
        for i in range(p.rotors):
            m.y[YAW] += h.drag[i]
        for a in range(4):
            x = a * PER_AXIS
            left[a] = m.y[a] - dot(h.h[a], b.s, a, THETA + p.rotors) + b.s[x + B1] + b.s[x + B2] + b.s[x + B3]
            trust[a] = 1.0
            learns[a] = m.counts[a] and flying[t]
        b.update(p, h, m, share)
        learned.step(p, left, learns, trust)
