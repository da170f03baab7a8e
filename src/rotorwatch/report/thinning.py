"""Series thinned to what a screen can show, without losing a peak."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from rotorwatch.flight.diagnosis import Diagnosis, Trace

OVERVIEW_ROWS, DETAIL_ROWS = 1600, 2400  # a wide screen's worth of the whole flight, and full rate around events
DETAIL_S = (5.0, 8.0)  # before an event's onset, after its announcement


class Screen:
    """Thins a trace to what a screen can show: a least and a greatest value per bucket, every tick around events.

    Peaks survive because each bucket of ticks becomes two rows that hold its extremes, in the order of its trend.
    """

    def __init__(self, time: np.ndarray, windows: list[tuple[float, float]], overview: int = OVERVIEW_ROWS, detail: int = DETAIL_ROWS):
        """time (T,): of the ticks. windows: stretches that get `detail` rows, all else `overview` rows, at most."""
        inside = within(time, windows)
        close, wide = (max(1.0, 2.0 * k / rows) for k, rows in ((inside.sum(), detail), ((~inside).sum(), overview)))
        stride = np.where(inside, close, wide)
        bucket = np.floor(np.cumsum(1.0 / stride) - 1.0 / stride + 1e-9)
        self.start = np.flatnonzero(np.diff(bucket, prepend=-1.0))
        self.last = np.append(self.start[1:], time.size) - 1
        twice = (self.last > self.start).astype(int) + 1
        self.first = np.cumsum(twice) - twice  # row of each bucket's first value
        self.second = self.first + twice - 1  # the same row where a bucket is one tick
        self.time = np.empty(int(twice.sum()))
        self.time[self.second] = time[(self.start + self.last + 1) // 2]
        self.time[self.first] = time[self.start]

    def least(self, values: np.ndarray) -> np.ndarray:
        """The lower edge of a band."""
        low = np.fmin.reduceat(values, self.start)
        return self._rows(low, low)

    def greatest(self, values: np.ndarray) -> np.ndarray:
        """The upper edge of a band."""
        high = np.fmax.reduceat(values, self.start)
        return self._rows(high, high)

    def line(self, values: np.ndarray) -> np.ndarray:
        """Both extremes of each bucket; rising buckets start with the least."""
        low, high = np.fmin.reduceat(values, self.start), np.fmax.reduceat(values, self.start)
        rising = ~(values[self.last] < values[self.start])
        return self._rows(np.where(rising, low, high), np.where(rising, high, low))

    def _rows(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        out = np.empty(self.time.size, np.float32)
        out[self.second] = second
        out[self.first] = first
        return out


def within(time: np.ndarray, spans: Iterable[tuple[float, float]]) -> np.ndarray:
    """(T,) bool: which times lie in one of the spans."""
    return np.any([np.zeros(time.size, bool), *((time >= a) & (time <= b) for a, b in spans)], axis=0)


def airborne(trace: Trace) -> np.ndarray:
    """(T,) bool: airborne, where estimates are meaningful; all True when no part was found airborne."""
    return within(trace.time, trace.airborne or [(-np.inf, np.inf)])


def windows(diagnosis: Diagnosis) -> list[tuple[float, float]]:
    """Stretches around the events, to be kept at full rate."""
    before, after = DETAIL_S
    out = [(e.onset_s - before, e.detected_s + after) for e in diagnosis.events]
    return out + [(e.end_s - before, e.end_s + before) for e in diagnosis.events if e.end_s is not None]
