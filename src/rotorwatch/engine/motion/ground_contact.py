"""Ticks in which the ground carries a part of the vehicle.

In the air the rotors carry all of it: their commanded thrust per load is what it is later, or was before, but for climb and descent. On a
leg they carry less, and a weak rotor is the opposite: it is commanded more. So less thrust per load than usual, at the begin or the end of
a flight, is the ground, which does not move.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.tick_table import GROUND, JUDGE, Ticks

LIFTED, LANDS = 0.95, 0.92  # of the usual thrust per load: carried by the rotors alone; no more
MEAN_S, BEFORE_S = 0.5, 0.7  # of the mean; a first leg touches so long before it shows
LIFTS_S, LANDS_S = 6.0, 15.0  # s within which a flight begins and ends on the ground
USUAL_S = 20.0  # of judged flight next to that
STILL = 0.5  # m/s along the thrust axis, above which it is not on the ground
STANDS = 0.6  # of the usual hover command, below which all of a flight is on the ground: no vehicle drops so much weight
MOSTLY = 0.7  # share of the ticks from a first contact to the end that the ground carries


def on_ground(ticks: Ticks, air: Spans = (), air_effect: float = 0.0) -> np.ndarray:
    """(T,) bool: the ground carries a part. air: ((start, end), ...) s of each flight; air_effect: share of thrust per m/s of climb."""
    axial = np.zeros(len(ticks.time)) if ticks.axial is None else np.nan_to_num(ticks.axial)
    # All rotors together, and the middle one of them, which does not change where a weak rotor is commanded more.
    carried = np.stack([ticks.thrust.mean(axis=1), median(ticks.thrust, axis=1)], axis=1) - air_effect * axial[:, None]
    carried = np.where(ticks.valid[:, 3:], carried / np.maximum(ticks.load, 0.3)[:, None], np.nan)
    known, moves = np.isfinite(carried[:, 0]), abs(axial) > STILL
    found = np.zeros(len(known), bool)
    judged = (ticks.mode == JUDGE) & known
    if not judged.any():
        return found
    usual, hover = median(carried[judged], axis=0), float(median(ticks.hover[judged]))
    starts = np.flatnonzero(ticks.restart)
    for first, last in zip(starts, [*starts[1:], len(known)]):
        hop = np.flatnonzero((ticks.mode[first:last] > GROUND) & known[first:last]) + first
        if hop.size:
            found[hop] = _hop(carried[hop], judged[hop], moves[hop], ticks.dt, usual)
    for start, end in air:
        rows = (ticks.time >= start) & (ticks.time <= end)
        if rows.any() and ticks.hover[rows].max() < STANDS * hover:
            found |= rows
    return found


def _hop(carried: np.ndarray, judged: np.ndarray, moves: np.ndarray, dt: float, usual: np.ndarray) -> np.ndarray:
    """The same of one flight. carried (T, 2): thrust per load of all rotors and of the middle one; usual (2,): of all flights, where this
    one has not been judged."""
    width = max(1, round(MEAN_S / dt))
    padded = np.pad(carried, ((width // 2, width - 1 - width // 2), (0, 0)), "edge")
    mean = np.stack([np.convolve(column, np.ones(width) / width, "valid") for column in padded.T], axis=1)
    near, found = np.flatnonzero(judged), np.zeros(len(carried), bool)
    count, many = round(USUAL_S / dt), (round(LIFTS_S / dt), round(LANDS_S / dt))
    first, last = (median(carried[k], axis=0) for k in (near[:count], near[-count:])) if near.size else (usual, usual)
    lifts = ((mean < LIFTED * first).all(axis=1) & ~moves)[: many[0]]
    if lifts[0]:
        found[: (len(lifts) if lifts.all() else int(np.argmin(lifts))) + width] = True
    lands = ((mean < np.array([LANDS, LIFTED]) * last).all(axis=1) & ~moves)[-many[1] :]
    share = np.cumsum(lands[::-1])[::-1] / np.arange(len(lands), 0, -1)
    begins = np.flatnonzero(lands & (share >= MOSTLY))
    if lands[-1] and begins.size:
        found[max(0, len(carried) - len(lands) + int(begins[0]) - round(BEFORE_S / dt)) :] = True
    return found
