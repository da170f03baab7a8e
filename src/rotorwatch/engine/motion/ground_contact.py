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
    carried = ticks.thrust.mean(axis=1)
    moves = np.zeros(len(carried), bool)
    if ticks.axial is not None:
        axial = np.nan_to_num(ticks.axial)
        carried, moves = carried - air_effect * axial, abs(axial) > STILL
    carried = np.where(ticks.valid[:, 3], carried / np.maximum(ticks.load, 0.3), np.nan)
    found = np.zeros(len(carried), bool)
    judged = (ticks.mode == JUDGE) & np.isfinite(carried)
    if not judged.any():
        return found
    usual, hover = float(median(carried[judged])), float(median(ticks.hover[judged]))
    starts = np.flatnonzero(ticks.restart)
    for first, last in zip(starts, [*starts[1:], len(carried)]):
        hop = np.flatnonzero((ticks.mode[first:last] > GROUND) & np.isfinite(carried[first:last])) + first
        if hop.size:
            found[hop] = _hop(carried[hop], judged[hop], moves[hop], ticks.dt, usual)
    for start, end in air:
        rows = (ticks.time >= start) & (ticks.time <= end)
        if rows.any() and ticks.hover[rows].max() < STANDS * hover:
            found |= rows
    return found


def _hop(carried: np.ndarray, judged: np.ndarray, moves: np.ndarray, dt: float, usual: float) -> np.ndarray:
    """The same of one flight. usual: of all flights, where this one has not been judged."""
    width = max(1, round(MEAN_S / dt))
    mean = np.convolve(np.pad(carried, (width // 2, width - 1 - width // 2), "edge"), np.ones(width) / width, "valid")
    near, found = np.flatnonzero(judged), np.zeros(len(carried), bool)
    count = round(USUAL_S / dt)
    first, last = (median(carried[near[:count]]), median(carried[near[-count:]])) if near.size else (usual, usual)
    lifts = (mean < LIFTED * first)[: round(LIFTS_S / dt)] & ~moves[: round(LIFTS_S / dt)]
    if lifts[0]:
        found[: (len(lifts) if lifts.all() else int(np.argmin(lifts))) + width] = True
    lands = (mean < LANDS * last)[-round(LANDS_S / dt) :] & ~moves[-round(LANDS_S / dt) :]
    share = np.cumsum(lands[::-1])[::-1] / np.arange(len(lands), 0, -1)
    begins = np.flatnonzero(lands & (share >= MOSTLY))
    if lands[-1] and begins.size:
        found[max(0, len(carried) - len(lands) + int(begins[0]) - round(BEFORE_S / dt)) :] = True
    return found
