"""Gyro, attitude and the rates used by the controller: three measurements of one rotation, compared."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, permutations, product

import numpy as np

from rotorwatch.engine.motion import turning
from rotorwatch.engine.motion.allocation import Spans, within
from rotorwatch.flight import Signal

MOVING = 0.05  # rad/s rms of angular rate, above which a mismatch of attitude and gyro means different rotations
# Parts of a flight with constant biases, consecutive windows that may share an error, and the number of standard errors allowed for a
# scale
PARTS, ALIKE_FOR, ERRORS = 10, 5, 3.0
WINDOW_S = 0.2  # s over which gyro and attitude are compared
PART_S = 10.0  # parts of a flight in which gyro and attitude are compared
# Share of the rotation that no choice of axes explains, and the factor by which the gyro's own axes must be worse
OF_AXES, AXES_BETTER = 0.15, 4.0
AXES = ("roll", "pitch", "yaw")


def turns(
    attitude: Signal, gyro: Signal, air: Spans, lags: Sequence[float] | np.ndarray = (0.0,)
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Windows in the air: times (m,) s, mean angular rates rad/s, body, from the attitude (m, 3), and from the gyro (lags, m, 3), later
    by so many s."""
    none = np.zeros(0), np.zeros((0, 3)), np.zeros((len(lags), 0, 3))
    fine = attitude.whole & within(attitude.time, air)
    step, rows = max(1, round(WINDOW_S * attitude.rate_hz)), np.flatnonzero(fine)
    known = gyro.wholes()
    when, rate = known.time, known.values
    if rows.size < 2 * step or when.size < 2:
        return none
    first, last = rows[:-step:step], rows[step::step]
    starts, ends = attitude.time[first], attitude.time[last]
    length = ends - starts
    count = np.searchsorted(when, ends) - np.searchsorted(when, starts)
    use = (length > 0.5 * WINDOW_S) & (length < 3.0 * WINDOW_S) & (count >= max(1, 0.3 * WINDOW_S * gyro.rate_hz))
    if not use.any():
        return none
    a, b = attitude.values[first[use]], attitude.values[last[use]]
    starts, ends, length = starts[use], ends[use], length[use, None]
    angle = turning.between(a, b)
    mean = np.empty((len(lags), len(starts), 3))
    total, steps = np.zeros(len(when)), np.diff(when)
    for axis in range(3):  # axes one after the other, to save memory in long flights
        np.add(rate[1:, axis], rate[:-1, axis], out=total[1:])
        total *= 0.5
        total[1:] *= steps
        np.cumsum(total[1:], out=total[1:])
        for turns, lag in zip(mean, lags):
            turns[:, axis] = np.interp(ends + lag, when, total) - np.interp(starts + lag, when, total)
    return starts, angle / length, mean / length


def together(gyro: Signal, rates: Signal, air: Spans) -> tuple[np.ndarray, np.ndarray]:
    """Means (m, 3) of two signals over the windows of `WINDOW_S` in the air that hold samples of both."""
    both_signals = gyro.wholes(), rates.wholes()
    start = min(s.time[0] for s in both_signals) if all(map(len, both_signals)) else 0.0
    bins = [np.floor((s.time - start) / WINDOW_S).astype(int) for s in both_signals]
    size = max((int(b[-1]) + 1 for b in bins if b.size), default=0)
    counts = [np.bincount(b, minlength=size) for b in bins]
    both = (counts[0] > 0) & (counts[1] > 0) & within(start + WINDOW_S * (np.arange(size) + 0.5), air)
    means = [
        np.stack([np.bincount(b, column, size)[both] / count[both] for column in s.values.T], axis=1)
        for s, b, count in zip(both_signals, bins, counts)
    ]
    return means[0], means[1]


def other_axes(rate: np.ndarray, turned: np.ndarray, what: str) -> str | None:
    """A sentence where a gyro's mean rates (m, 3) are those of other axes of `turned` (m, 3), or of reversed ones."""
    if len(rate) < 50:
        return None
    rate, turned = (np.clip(x, -5.0 * usual, 5.0 * usual) for x in (rate, turned) if (usual := np.sqrt(np.mean(x * x))) > 0.0)
    if len(rate) < 50 or np.sqrt(np.mean(turned**2)) < MOVING:
        return None
    rate, turned = rate - rate.mean(axis=0), turned - turned.mean(axis=0)
    both, power = rate.T @ turned, np.sum(rate**2) + np.sum(turned**2)
    left = power - 2.0 * float(np.trace(both))
    ways = ((order, signs) for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3))
    order, signs = max(ways, key=lambda way: sum(sign * both[axis, k] for k, (axis, sign) in enumerate(zip(*way))))
    best = power - 2.0 * sum(sign * both[axis, k] for k, (axis, sign) in enumerate(zip(order, signs)))
    if best > OF_AXES * power or left < AXES_BETTER * best + OF_AXES * power:
        return None
    moved = [
        f"{AXES[k]} as {'reversed ' if sign < 0.0 else ''}{AXES[axis]}"
        for k, (axis, sign) in enumerate(zip(order, signs))
        if (axis, sign) != (k, 1.0) and np.sum(turned[:, k] ** 2) > 0.02 * np.sum(turned**2)
    ]
    return f"the axes of the gyro are not those of {what}: it shows {', '.join(moved)}." if moved else None


def alike_at(turns: tuple[np.ndarray, np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """When parts of the flight begin (parts,) s, and correlation of gyro and attitude in each at the lags of `turns` (lags, parts, 3)."""
    time, turned, rates = turns
    count = int(np.ptp(time) / PART_S) if time.size else 0
    edges = np.searchsorted(time, time[:1] + PART_S * np.arange(count + 1))
    parts = [slice(a, b) for a, b in pairwise(edges) if b - a > 0.5 * PART_S / WINDOW_S]
    alike = np.zeros((len(rates), len(parts), 3))
    for k, part in enumerate(parts):
        x, y = turned[part] - turned[part].mean(axis=0), rates[:, part] - rates[:, part].mean(axis=1, keepdims=True)
        size = np.sqrt(np.sum(x * x, axis=0) * np.sum(y * y, axis=1))
        alike[:, k] = np.sum(x * y, axis=1) / np.maximum(size, 1e-12)
    return np.array([time[part.start] for part in parts]), alike


def scale(measured: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """(least, most) ratio of one measurement (n,) of a motion to another (n,), both with unknown errors.

    The slope on `true` is too low by the errors of `true`, the inverse of the slope on `measured` too high by those of `measured`, each
    with its standard error, as `ALIKE_FOR` neighbours in time may have the same error. Biases of parts of the flight are left out.
    """
    x, y = (np.concatenate([part - part.mean() for part in np.array_split(z, PARTS)]) for z in (measured, true))

    def least_slope(a: np.ndarray, b: np.ndarray) -> float:
        """Slope of a on b, less its standard errors."""
        power = max(float(b @ b), 1e-30)
        slope = float(a @ b) / power
        return slope - ERRORS * float(np.sqrt(ALIKE_FOR * np.sum((b * (a - slope * b)) ** 2))) / power

    return max(least_slope(x, y), 1e-9), 1.0 / max(least_slope(y, x), 1e-9)
