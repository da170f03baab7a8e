"""Learn the default estimator's gains and noise of a vehicle from healthy flights."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.engine.bindings.plant_rows import any_multirotor, lower_rotors
from rotorwatch.engine.bindings.program import Learned, estimate
from rotorwatch.engine.estimator.plant import AIR, DAMPING, GAIN, PER_AXIS, SHARE
from rotorwatch.engine.motion.tick_table import ASSESS, TICKS_S, Ticks

FLIGHTS_DIFFER = 0.25
LEARNED_WEIGHT = 2.0  # samples a lag that the noise of healthy flights counts for
# Variances grow by factors: one learned as zero could never grow in a rougher flight.
LEAST_SHARE = 0.05


def learn(tables: Sequence[Ticks], B: np.ndarray) -> dict | None:
    """Learn from healthy flights: x0 (20), P0 (20, 20), noise (4, 4), noise_weight; None when none of them is long enough.

    Gains and damping: precision-weighted mean over the flights, with their spread added. Biases are not learned: each flight has its own.
    Noise: the largest of the flights', per component and axis.
    """
    rows = (np.arange(4)[:, None] * PER_AXIS + np.array([GAIN, DAMPING])).reshape(-1)
    means, precisions, noises, shares = [], [], [], []
    for table in tables:
        if (table.mode == ASSESS).sum() * table.dt < 10.0 or table.dt not in TICKS_S:
            continue
        carry, _ = estimate(table, B)
        means.append(np.asarray(carry.s)[rows])
        precisions.append(1.0 / np.maximum(np.diag(np.asarray(carry.P))[rows], 1e-12))
        noises.append(np.asarray(carry.variances))
        # Effect of the air and, on coaxial frames, the lower rotors' share.
        shares.append([(float(carry.s[k]), float(carry.P[k, k])) for k in (AIR, SHARE)])
    if not means:
        return None
    loudest = np.max(noises, axis=0)
    loudest = np.maximum(loudest, LEAST_SHARE * loudest.max(axis=0))
    mean = np.average(means, axis=0, weights=precisions)
    spread = np.average((np.array(means) - mean) ** 2, axis=0, weights=precisions)
    x0, P0 = any_multirotor(B.shape[1])
    x0[rows] = mean
    # Few flights do not show the variation between flights: until there are many, part of the variation between vehicles is kept.
    open_ = FLIGHTS_DIFFER * np.diag(P0)[rows] / len(means)
    variance = np.minimum(np.diag(P0)[rows], 1.0 / np.sum(precisions, axis=0) + spread + open_)
    P0[rows[:, None], rows] = np.diag(variance)
    # ... and likewise for the air and the lower rotors' share.
    own = [[float(m), float(v + s)] for (m, v), s in zip(np.mean(shares, axis=0), np.var(shares, axis=0)[:, 0])]
    known = {"air": own[0], **({"share": own[1]} if lower_rotors(B) is not None else {})}
    return {
        "x0": x0.tolist(), "P0": P0.tolist(), "noise": loudest.tolist(), "noise_weight": LEARNED_WEIGHT,
        "dt": tables[0].dt, **known,
    }  # fmt: skip


def dynamics(carry: Learned, B: np.ndarray) -> dict:
    """Dynamics for `program.parameters` from the last state of a flight's first pass: its gains, damping and noise; biases open."""
    rows = (np.arange(4)[:, None] * PER_AXIS + np.array([GAIN, DAMPING])).reshape(-1)
    s, P = np.asarray(carry.s), np.asarray(carry.P)
    x0, P0 = (a.copy() for a in any_multirotor(B.shape[1]))
    x0[rows] = s[rows]
    P0[rows], P0[:, rows] = 0.0, 0.0
    P0[rows[:, None], rows] = P[rows[:, None], rows]
    known = {"x0": x0, "P0": P0, "noise": np.asarray(carry.variances), "noise_weight": LEARNED_WEIGHT}
    also = {"air": AIR, **({"share": SHARE} if lower_rotors(B) is not None else {})}
    known |= {name: [float(s[k]), float(P[k, k])] for name, k in also.items()}
    return known
