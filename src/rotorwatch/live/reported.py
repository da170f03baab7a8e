"""What the autopilot of a vehicle that is watched reports, and what it measures beyond limits: as of a log that ends now."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping

import numpy as np

from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight import Flight, Message, Signal
from rotorwatch.flight.diagnosis import Event
from rotorwatch.live.window import Window, copied
from rotorwatch.witnesses import reports

NAMES = ("battery", "vibration", "clipping", "innovations")
ALONE = frozenset(NAMES) - {"battery"}  # signals that nothing else is made of
WINDOW_S = 600.0  # of samples; what was found in those that are forgotten stays
EVERY_S = 1.0  # of the vehicle's time, between two looks
MOST = 1000  # reports that are kept, the newest


class Reported:
    """Of one vehicle. found: claims, as they look now; revision: grows when these may be others."""

    def __init__(self, about: Flight):
        self._window, self._messages = Window(about), deque[Message](maxlen=MOST)
        self._looked, self._fresh = -np.inf, False
        self.found: tuple[Event, ...] = ()
        self.revision = 0

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """More of the flight, in time order."""
        self._window.add({name: s for name, s in signals.items() if name in NAMES})
        new = [
            m for m in messages if m.kind == "health" or (m.kind in reports.WRITES and reports.trouble(m) is not None)
        ]
        self._messages += new
        self._fresh |= bool(new)

    def follow(self, spans: Spans, lost: tuple[float, ...], now: float, final: bool = False) -> None:
        """Look again, where something has come. spans: the flights ((start, end), ...) s, infinite while it flies; lost: when control was
        lost [s]; final: nothing will come after."""
        if not (final or self._fresh or now - self._looked >= EVERY_S):
            return
        self._looked, self._fresh = now, False
        since = now - WINDOW_S
        self._window.forget(since)
        flight = copied(self._window.flight(since), messages=tuple(self._messages))
        kept = [e for e in self.found if "texts" not in e.extra and e.onset_s < since + reports.LASTS_S]
        known = {e.extra["trouble"] for e in kept}
        new = [e for e in reports.claims(flight, spans, lost) if "texts" in e.extra or e.extra["trouble"] not in known]
        found = tuple(sorted((*kept, *new), key=lambda e: e.onset_s))
        self.revision += [(e.extra["trouble"], e.onset_s) for e in found] != [
            (e.extra["trouble"], e.onset_s) for e in self.found
        ]
        self.found = found
