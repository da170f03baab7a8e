"""Unfiltered accelerometers and gyros for `witnesses/balance`, of all formats that log them faster than others need.

They are read only beside rotor speeds, without which nobody uses them, and thinned to about ENOUGH_HZ: tones alias, which order tracking
does not mind, and noise grows little. Values that no sensor can mean make a sample invalid without a note: no verdict rests on it.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.flight import Signal
from rotorwatch.logs import series

ENOUGH_HZ = 1000.0
LEAST = 100  # samples
LEAST_HZ = 100.0  # slower ones are only what a logger shows beside others


def build(kind: str, time: np.ndarray, values: np.ndarray, source: str) -> Signal | None:
    """The signal raw_accel or raw_gyro from all samples, times (n,) s, values (n, 3) m/s^2 or rad/s; None where it is too slow or empty."""
    if len(time) < LEAST:
        return None
    order = np.argsort(time, kind="stable")
    time = time[order]
    step = float(median(np.diff(time)))
    if not step > 0.0 or step > 1.0 / LEAST_HZ:
        return None
    stride = max(1, round(1.0 / (step * ENOUGH_HZ)))
    return series.signal(kind, time[::stride], values[order][::stride], source, [])


def spread(end: np.ndarray, step: np.ndarray, count: np.ndarray, first: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(times, rows, places) of the samples of blocks: `count` (b,) samples `step` (b,) s apart, the last at `end` (b,) s; first: the first
    there."""
    rows = np.repeat(np.arange(len(count)), count)
    places = np.arange(rows.size) - np.repeat(np.cumsum(count) - count, count)
    ahead = places if first else places - (count[rows] - 1)
    return end[rows] + ahead * step[rows], rows, places
