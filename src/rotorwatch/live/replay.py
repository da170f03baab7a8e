"""A recorded flight fed piece by piece, in real time, faster, or as fast as it can be processed."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch.flight import Flight
from rotorwatch.live.watched import Watched
from rotorwatch.witnesses.aerobatic import assess as aerobatic

STEP_S, FAST_STEP_S = 0.05, 1.0


class Replay:
    """A log. speed: relative to real time; infinite: as fast as possible. Raises ConfigError for a vehicle that never hovers."""

    def __init__(self, flight: Flight, watched: Watched, speed: float = np.inf):
        if aerobatic.flown_by_rates(flight):
            raise ConfigError(f"{flight.name or 'The log'} is of a firmware without a telemetry link: use `rotorwatch diagnose`.")
        times = [s.time for s in flight.signals.values() if len(s)]
        self._now = min((float(t[0]) for t in times), default=0.0)
        self._end = max((float(t[-1]) for t in times), default=0.0)
        self._flight, self.watched, self._speed = flight, watched, speed
        self._first, self._began = self._now, time.monotonic()
        self._step = FAST_STEP_S if np.isinf(speed) else STEP_S * max(1.0, min(speed, FAST_STEP_S / STEP_S))
        self._before = -np.inf
        watched.begin(replace(flight, signals={}, messages=()))

    @property
    def vehicles(self) -> tuple[Watched, ...]:
        return (self.watched,)

    def poll(self, wait_s: float = 0.05) -> bool:
        """Feed the next piece when it is due; False when there is none left."""
        if self._before > self._end:
            return False
        now = self._now + self._step
        if np.isfinite(self._speed):
            ahead = (now - self._first) / self._speed - (time.monotonic() - self._began)
            if ahead > 0.0:
                time.sleep(min(ahead, wait_s))
                if ahead > wait_s:
                    return True
        signals = {name: s.between(self._before, now) for name, s in self._flight.signals.items()}
        messages = [m for m in self._flight.messages if self._before <= m.time < now]
        self._now = self._before = now
        self.watched.health.last_frame = time.monotonic()
        self.watched.health.taken += sum(len(s) for s in signals.values())
        self.watched.add({name: s for name, s in signals.items() if len(s)}, messages)
        self.watched.advance(float(np.nextafter(now, -np.inf)))
        if now > self._end:
            self.watched.finish(self._flight.duration)
        return True

    def shown(self) -> list[tuple[Watched, str]]:
        """The vehicle; nothing is missing of it."""
        return [(self.watched, "")]

    def leave(self) -> None:
        """No state to restore."""
        if self._before <= self._end:
            self.watched.finish()
