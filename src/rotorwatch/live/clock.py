"""A vehicle's own clock on a link: its stamps put in order, reboots and damaged stamps distinguished."""

from __future__ import annotations

import math

WRAP_US = 2.0**32  # SERVO_OUTPUT_RAW's microseconds start again there
BACK_US = 0.5e6  # messages of one moment come in any order; a longer step back is no matter of that
AHEAD_US = 10e6  # a stamp so much ahead of what the time of arrival allows is damaged, unless others follow it
AGREEING = 5  # stamps in a row that agree on another time are believed


class Clock:
    """start: the vehicle's first stamp [us], None before. now: the latest one [s since start]. restarted: how often it was set back or
    ahead; `began` is called then, before the message that shows it is taken."""

    def __init__(self):
        self.start: float | None = None
        self._last = self._arrived = 0.0
        self._other: list[float] = []
        self.refused = 0

    @property
    def now(self) -> float:
        return 0.0 if self.start is None else (self._last - self.start) * 1e-6

    def take(self, stamp: float, arrival: float, short: bool) -> float | None:
        """Time [s since start] of a message with this stamp [us] that arrived at `arrival` [s, any clock that does not jump]; short: of 32
        bits. None for a stamp that is not believed. Raises Restarted when the vehicle's clock began anew."""
        if not (math.isfinite(stamp) and 0 < stamp < 1e14):
            return None
        if self.start is None:
            if short:
                return None
            self.start = self._last = stamp
            self._arrived = arrival
        if short:
            stamp += WRAP_US * round((self._last - stamp) / WRAP_US)
        ahead = stamp - self._last
        if -BACK_US <= ahead <= AHEAD_US + 1e6 * max(arrival - self._arrived, 0.0):
            self._other.clear()
            if ahead > 0.0:
                self._last, self._arrived = stamp, arrival
            return (stamp - self.start) * 1e-6
        self.refused += 1
        if self._other and abs(stamp - self._other[-1]) > AHEAD_US:
            self._other.clear()
        self._other = [*self._other[-AGREEING:], stamp]  # short ones alone decide nothing, however many come
        if len(self._other) >= AGREEING and not short:
            raise Restarted(reboot=bool(stamp < self._last))
        return None


class Restarted(Exception):
    """The vehicle's clock began anew: it booted, or its clock was set."""

    def __init__(self, reboot: bool):
        super().__init__(reboot)
        self.reboot = reboot
