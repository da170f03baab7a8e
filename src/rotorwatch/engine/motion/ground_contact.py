"""Ticks in which the ground carries a part of the vehicle.

In the air the rotors carry all of it: their commanded thrust per load is what it is later, or was before, but for climb and descent. On a
leg they carry less, and a weak rotor is the opposite: it is commanded more. So less thrust per load than usual, at the begin or the end of
a flight, is the ground.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.motion.tick_table import GROUND, JUDGE, Ticks

LIFTED, LANDS = 0.95, 0.92  # of the usual thrust per load: carried by the rotors alone; no more
MEAN_S, BEFORE_S = 0.5, 0.7  # of the mean; a first leg touches so long before it shows
LIFTS_S, LANDS_S = 6.0, 15.0  # s within which a flight begins and ends on the ground
USUAL_S = 20.0  # of judged flight next to that
MOSTLY = 0.7  # share of the ticks from a first contact to the end that the ground carries


def on_ground(ticks: Ticks, air_effect: float = 0.0) -> np.ndarray:
    """(T,) bool: the ground carries a part. air_effect: share of thrust per m/s of climb [s/m]."""
    carried = ticks.thrust.mean(axis=1)
    if ticks.axial is not None:
        carried = carried - air_effect * np.nan_to_num(ticks.axial)
    carried = np.where(ticks.valid[:, 3], carried / np.maximum(ticks.load, 0.3), np.nan)
    found = np.zeros(len(carried), bool)
    judged = (ticks.mode == JUDGE) & np.isfinite(carried)
    if not judged.any():
        return found
    starts = np.flatnonzero(ticks.restart)
    for first, last in zip(starts, [*starts[1:], len(carried)]):
        hop = np.flatnonzero((ticks.mode[first:last] > GROUND) & np.isfinite(carried[first:last])) + first
        if hop.size:
            found[hop] = _hop(carried[hop], judged[hop], ticks.dt, float(median(carried[judged])))
    return found


def _hop(carried: np.ndarray, judged: np.ndarray, dt: float, usual: float) -> np.ndarray:
    """The same of one flight. usual: of all flights, where this one has not been judged."""
    width = max(1, round(MEAN_S / dt))
    mean = np.convolve(np.pad(carried, (width // 2, width - 1 - width // 2), "edge"), np.ones(width) / width, "valid")
    near, found = np.flatnonzero(judged), np.zeros(len(carried), bool)
    count = round(USUAL_S / dt)
    first, last = (median(carried[near[:count]]), median(carried[near[-count:]])) if near.size else (usual, usual)
    lifts = mean[: round(LIFTS_S / dt)] < LIFTED * first
    if lifts[0]:
        found[: (len(lifts) if lifts.all() else int(np.argmin(lifts))) + width] = True
    lands = mean[-round(LANDS_S / dt) :] < LANDS * last
    share = np.cumsum(lands[::-1])[::-1] / np.arange(len(lands), 0, -1)
    begins = np.flatnonzero(lands & (share >= MOSTLY))
    if lands[-1] and begins.size:
        found[max(0, len(carried) - len(lands) + int(begins[0]) - round(BEFORE_S / dt)) :] = True
    return found
