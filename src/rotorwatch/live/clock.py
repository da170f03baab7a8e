"""A vehicle's own clock on a link: its stamps in order, with reboots and wrong stamps distinguished."""

from __future__ import annotations

import math

WRAP_US = 2.0**32  # SERVO_OUTPUT_RAW's microseconds start again there
BACK_US = 0.5e6  # messages of one moment come in any order; a longer step back has another cause
# A link only delays: no stamp is further ahead of its arrival than that of the least delayed message, within this.
AHEAD_US = 0.1e6
SET_US = 10e6  # a longer step ahead that others follow is a clock that was set; a shorter one is a link with less delay
# Number and span of successive stamps, none fitting the clock, that show that it restarted.
AGREEING, AGREEING_S, TOGETHER_US = 5, 0.25, 2e6


class Clock:
    """start: the vehicle's first stamp [us], None before. now: the latest one [s since start]. refused: number of rejected stamps."""

    def __init__(self):
        self.start: float | None = None
        self._last = 0.0
        self._lead = 0.0  # of the least delayed message: its stamp less its arrival [us]
        self._other: list[tuple[float, float]] = []  # (stamp us, arrival s) of successive stamps that do not fit, first and latest
        self._others = 0
        self.refused = 0

    @property
    def now(self) -> float:
        return 0.0 if self.start is None else (self._last - self.start) * 1e-6

    def take(self, stamp: float, arrival: float, short: bool) -> float | None:
        """Time [s since start] of a message with this stamp [us] that arrived at `arrival` [s, any monotonic clock]; short: a 32-bit stamp.
        None for a rejected stamp. Raises Restarted when the vehicle's clock restarted."""
        if not (math.isfinite(stamp) and 0 < stamp < 1e14):
            return None
        if self.start is None:
            if short:
                return None
            self.start = stamp
            self._set(stamp, arrival)
        if short:
            stamp += WRAP_US * round((self._last - stamp) / WRAP_US)
        latest = max(self._last, 1e6 * arrival + self._lead)
        if self._last - BACK_US <= stamp <= latest + AHEAD_US:
            self._others = 0
            if stamp > self._last:
                self._last, self._lead = stamp, max(self._lead, stamp - 1e6 * arrival)
            return (stamp - self.start) * 1e-6
        self.refused += 1
        if short or not self._agreed(stamp, arrival):  # 32-bit stamps decide nothing: their wraps are counted by this clock
            return None
        if not self._last < stamp <= latest + SET_US:
            raise Restarted(reboot=bool(stamp < self._last))
        self._set(stamp, arrival)
        return (stamp - self.start) * 1e-6

    def _set(self, stamp: float, arrival: float) -> None:
        self._last, self._lead, self._others = stamp, stamp - 1e6 * arrival, 0

    def _agreed(self, stamp: float, arrival: float) -> bool:
        """True if enough successive stamps, this one the last, follow each other."""
        if self._others:
            before, came = self._other[1]
            if abs(stamp - before - 1e6 * (arrival - came)) > TOGETHER_US:
                self._others = 0
        self._others += 1
        self._other = [self._other[0] if self._others > 1 else (stamp, arrival), (stamp, arrival)]
        return self._others >= AGREEING and arrival - self._other[0][1] >= AGREEING_S


class Restarted(Exception):
    """The vehicle's clock restarted: it rebooted, or its clock was set."""

    def __init__(self, reboot: bool):
        super().__init__(reboot)
        self.reboot = reboot
