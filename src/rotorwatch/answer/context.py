"""Context of a flight beside its answer: position, speed, battery, vibration. No verdict depends on it.

Series are on the estimator's ticks. A gap of the log stays a gap; the time between samples of a slow signal does not.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base import windows
from rotorwatch.base.arrays import median
from rotorwatch.flight import Flight, Signal

GAP_S, GAP_STEPS = 0.6, 4.0
"""A gap is longer than this, and than so many usual intervals of the signal."""
LEAST_HZ = 20.0
"""An accelerometer that is logged more slowly says nothing of vibration."""
MOTION_S, SPREAD_S = 0.2, 0.5
"""The mean over the first is the motion (up to about 2 Hz); the standard deviation of what is left is taken over the second."""


def gather(flight: Flight, time: np.ndarray, air: tuple[tuple[float, float], ...]) -> dict[str, np.ndarray | None]:
    """position, ground_speed, battery and vibration of a `Trace`: each (T, ..), NaN where unknown, or None where not logged.

    time (T,): of the ticks. air: spans in the air; positions count from the first lift-off, so that the location on earth is not
    disclosed."""
    return {
        "position": _position(flight, time, air),
        "ground_speed": _ground_speed(flight, time),
        "battery": _columns(flight, "battery", (0, 1), time),
        "vibration": vibration(flight, time),
    }


def _position(flight: Flight, time: np.ndarray, air) -> np.ndarray | None:
    """(T, 3) north, east, down [m] from the lift-off: by the onboard estimate, else by GPS; the height else by the barometer."""
    level = _first(flight, time, (("position", (0, 1)), ("gps", (0, 1))))
    down = _first(flight, time, (("position", (2,)), ("gps", (2,))))
    if down is None and (up := _columns(flight, "baro", (0,), time)) is not None:
        down = -up
    if level is None and down is None:
        return None
    unknown = np.full(time.size, np.nan)
    parts = [*(level.T if level is not None else (unknown, unknown)), down[:, 0] if down is not None else unknown]
    for values in parts:
        known = np.flatnonzero(np.isfinite(values))
        later = known[time[known] >= (air[0][0] if air else -np.inf)]
        if known.size:
            values -= values[later[0] if later.size else known[-1]]
    return np.stack(parts, axis=1)


def _ground_speed(flight: Flight, time: np.ndarray) -> np.ndarray | None:
    """(T,) m/s over the ground: by the onboard estimate, else by GPS."""
    velocity = _first(flight, time, (("velocity", (0, 1)),))
    if velocity is not None:
        return np.hypot(*velocity.T)
    speed = _first(flight, time, (("gps", (3,)),))
    return None if speed is None else speed[:, 0]


def _first(flight: Flight, time: np.ndarray, choices) -> np.ndarray | None:
    """The columns of the first of the signals that has them all."""
    candidates = (_columns(flight, name, columns, time) for name, columns in choices)
    return next((values for values in candidates if values is not None and np.isfinite(values).all(axis=1).any()), None)


def _columns(flight: Flight, name: str, columns: tuple[int, ...], time: np.ndarray) -> np.ndarray | None:
    """(T, k) columns of a signal, interpolated linearly; None where it has none of them."""
    if not flight.has(name):
        return None
    signal = flight[name]
    out = np.stack([_straight(signal, column, time) for column in columns], axis=1)
    return out if np.isfinite(out).any() else None


def _straight(signal: Signal, column: int, time: np.ndarray) -> np.ndarray:
    """(T,) a column, interpolated linearly between valid samples; NaN in gaps, before the first and after the last."""
    fine = signal.valid[:, column]
    return _between(signal.time[fine], signal.values[fine, column], time)


def _between(when: np.ndarray, values: np.ndarray, time: np.ndarray) -> np.ndarray:
    if when.size < 2:
        return np.full(time.size, np.nan)
    gap = max(GAP_S, GAP_STEPS * float(median(np.diff(when))))
    after = np.clip(np.searchsorted(when, time), 1, when.size - 1)
    known = (when[after] - when[after - 1] <= gap) & (time >= when[0]) & (time <= when[-1])
    return np.where(known, np.interp(time, when, values), np.nan)


def vibration(flight: Flight, time: np.ndarray) -> np.ndarray | None:
    """(T, 3) standard deviation [m/s^2] of the accelerometer above the motion, body x, y, z; None where it is logged too slowly."""
    if not flight.has("accel") or flight["accel"].rate_hz < LEAST_HZ:
        return None
    signal = flight["accel"].wholes()
    when, force = signal.time, signal.values
    if when.size < 2:
        return None
    (low, high), variance = _around(when, time, SPREAD_S), np.empty((time.size, 3))
    for some in windows.groups(low, high):
        begin, end = int(low[some.start]), int(high[some.stop - 1])
        first, last = _around(when, when[begin:end], MOTION_S)
        count = last - first
        motion = windows.sums(force, first, last) / np.maximum(count, 1)[:, None]
        # Subtracting the mean of k samples removes 1/k of the variance of white noise.
        factor = np.where(count >= 3, count / np.maximum(count - 1, 1), 0.0)[:, None]
        above = np.square(force[begin:end] - motion) * factor
        variance[some] = windows.sums(above, low[some] - begin, high[some] - begin)
    count = (high - low)[:, None]
    return np.where(count >= 0.5 * SPREAD_S * LEAST_HZ, np.sqrt(variance / np.maximum(count, 1)), np.nan)


def _around(when: np.ndarray, at: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """First row of those within `width` s around each of the times `at`, and the row after the last."""
    return np.searchsorted(when, at - width / 2), np.searchsorted(when, at + width / 2, side="right")
