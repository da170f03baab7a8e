"""Consistency test of a link's samples: `motion.trust` repeated during the flight, as once for a whole log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotorwatch.engine.motion import trust
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.tick_table import Ticks, joined
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle

MEMORY_S = 120.0  # of the flight tested
EVERY_S = 10.0  # between two tests while nothing new is announced
CLEAR_S = 60.0  # without a contradiction, before a doubt is dropped in flight


class Consistency:
    """doubt: why the samples cannot be of what flies, one sentence; empty while they are consistent."""

    def __init__(self, vehicle: Vehicle):
        self._vehicle = vehicle
        self._looked, self._contradicted, self._revision = -np.inf, -np.inf, 0
        self._until = self._landed = -np.inf  # events up to then are doubted: now, and in flights that have ended
        self.doubt = ""

    def due(self, now: float, revision: int) -> bool:
        """Return whether a test is due at `now` s: always before something new is announced. revision: of the events."""
        return revision != self._revision or now - self._looked >= EVERY_S

    def examine(self, flight: Flight, tables: Sequence[Ticks], spans: Spans, now: float, revision: int) -> None:
        """Test the last minutes for contradictions. flight: their samples; tables: their ticks; spans: (start, end) s of each flight, end
        infinite while airborne."""
        self._looked, self._revision, since = now, revision, now - MEMORY_S
        recent = [table for table in tables if table.time[-1] >= since]
        air = tuple((max(start, since), min(end, now)) for start, end in spans if end > since)
        if not air or not recent or not flight.has("motors"):
            return
        found = trust.contradictions(flight, self._vehicle, air, joined(recent))
        if found:
            self.doubt, self._contradicted = found[0], now
        elif now - self._contradicted > CLEAR_S:
            self.doubt = ""
        self._until = spans[-1][1] if self.doubt else -np.inf
        if np.isfinite(self._until):
            self._landed = max(self._landed, self._until)

    @property
    def until(self) -> float:
        """Events up to then rest on doubted outputs [s]."""
        return max(self._until, self._landed)
