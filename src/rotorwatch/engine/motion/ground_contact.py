"""Ticks in which the ground carries a part of the vehicle.

In the air the rotors carry all of it: their commanded thrust per load is what it is later, or was before, but for climb and descent. On a
leg they carry less, and a weak rotor is the opposite: it is commanded more. So less thrust per load than usual, at the begin or the end of
a flight, is the ground, which does not move.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.engine.definition import ENGINE
from rotorwatch.engine.events import carried
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.tick_table import Ticks


def on_ground(ticks: Ticks, air: Spans = (), air_effect: float = 0.0) -> np.ndarray:
    """(T,) bool: the ground carries a part. air: ((start, end), ...) s of each flight; air_effect: share of thrust per m/s of climb."""
    n, rotors = ticks.thrust.shape
    found = np.zeros(n, bool)
    axial = np.full(n, np.nan) if ticks.axial is None else ticks.axial
    columns = (ticks.time, float), (ticks.thrust, float), (ticks.load, float), (ticks.valid[:, 3], bool), (ticks.mode, np.int32)
    columns += (ticks.restart, bool), (ticks.hover, float), (axial, float)
    starts, ends = np.array(air, float).reshape(-1, 2).T.copy()
    scratch = np.empty((n, 2)), np.empty(n), np.empty(n, np.int32)
    tables = [np.ascontiguousarray(values, kind) for values, kind in columns]
    ENGINE.call(carried.on_ground, n, rotors, float(ticks.dt), *tables, air_effect, len(starts), starts, ends, *scratch, found)
    return found
