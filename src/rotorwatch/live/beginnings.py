"""Losses in the blind time of a vehicle that is watched: looked for again when REST_S of flight have shown its noise, and at its end."""

from __future__ import annotations

import numpy as np

from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.engine.motion.ticks import Ticks, joined
from rotorwatch.flight.diagnosis import Event
from rotorwatch.witnesses import hindsight

HOPS = 10  # whose beginnings are kept, the newest


class Beginnings:
    """The first ticks of each flight. found: losses that began in their blind time."""

    def __init__(self, B: np.ndarray, ready_s: float):
        """B (4, n): effectiveness; ready_s: blind time [s]."""
        self._B = B
        self._length = ready_s + hindsight.REST_S
        self._ticks: list[Ticks] = []
        self._looked = -np.inf
        self.found: tuple[Event, ...] = ()

    def add(self, table: Ticks, spans: Spans) -> None:
        """More ticks, of flights `spans` ((start, end), ...) s."""
        starts = np.array([start for start, _ in spans[-HOPS:]])
        hop = np.searchsorted(starts, table.time, "right") - 1
        near = (hop >= 0) & (table.time <= starts[np.maximum(hop, 0)] + self._length) if starts.size else hop > 0
        if near.any():
            self._ticks.append(table.part(near))

    def cut(self, end: float) -> None:
        """Forget the ticks after `end` s."""
        self._ticks = [t.part(t.time <= end) for t in self._ticks if t.time[0] <= end]

    def due(self, spans: Spans, now: float) -> bool:
        """Has a flight lasted long enough, at `now` s, or ended, since it was looked last?"""
        ends = [min(start + self._length, end) for start, end in spans]
        return any(self._looked < end <= now for end in ends)

    def search(self, carry, spans: Spans, now: float, final: bool = False) -> None:
        """Look at the last flight, at `now` s; final: at all that are kept. carry: what the estimator has come to."""
        self._looked = now
        recent = [start for start, _ in spans[-HOPS:]] or [now]
        first = recent[0] if final else recent[-1]
        self._ticks = [t for t in self._ticks if t.time[-1] >= recent[0]]
        ticks = [t for t in self._ticks if t.time[-1] >= first]
        if ticks:
            old = tuple(e for e in self.found if e.detected_s < first)
            self.found = (*old, *hindsight.find(carry, joined(ticks), self._B))
