"""Is what comes over a link what flies? `motion.trust` asked again and again, as `diagnose` asks it once of a whole log."""

from __future__ import annotations

import numpy as np

from rotorwatch.engine.motion import trust
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.ticks import Ticks, joined
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle

MEMORY_S = 120.0  # of the flight that is held against itself
EVERY_S = 10.0  # between two looks while nothing new is announced
CLEAR_S = 60.0  # without a contradiction, before a doubt is given up in flight


class Trust:
    """What the samples of one vehicle say of themselves. doubt: why they cannot be what flies, one sentence; empty while they are
    consistent."""

    def __init__(self, vehicle: Vehicle):
        self._vehicle = vehicle
        self._tables: list[Ticks] = []
        self._asked, self._contradicted, self._revision = -np.inf, -np.inf, 0
        self._until = (
            self._landed
        ) = -np.inf  # events up to then rest on what is doubted: now, and in flights that have ended
        self.doubt = ""

    def add(self, table: Ticks) -> None:
        """More ticks, as they were made of the samples."""
        self._tables.append(table)

    def due(self, now: float, revision: int) -> bool:
        """Whether to look again at `now` s. revision: of the events; before something new is announced it is always due."""
        return bool(self._tables) and (revision != self._revision or now - self._asked >= EVERY_S)

    def examine(self, flight: Flight, spans: Spans, now: float, revision: int) -> None:
        """Hold the last minutes against each other. flight: their samples; spans: (start, end) s in the air, infinite while it flies."""
        self._asked, self._revision, since = now, revision, now - MEMORY_S
        self._tables = [table for table in self._tables if table.time[-1] >= since]
        air = tuple((max(start, since), min(end, now)) for start, end in spans if end > since)
        if not air or not self._tables or not flight.has("motors"):
            return
        found = trust.contradictions(flight, self._vehicle, air, joined(self._tables))
        if found:
            self.doubt, self._contradicted = found[0], now
        elif now - self._contradicted > CLEAR_S:
            self.doubt = ""
        self._until = spans[-1][1] if self.doubt else -np.inf
        if np.isfinite(self._until):
            self._landed = max(self._landed, self._until)

    @property
    def until(self) -> float:
        """Events up to then rest on outputs that cannot be what flies [s]."""
        return max(self._until, self._landed)
