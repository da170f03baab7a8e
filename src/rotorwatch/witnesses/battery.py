"""Battery voltage: whether it fell, and whether by more than its current explains."""

from __future__ import annotations

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight import Flight, Signal

SAG = 0.85  # share of the usual voltage below which the power fails
BATTERY_S = 60.0  # of flight before, to which the dependence of voltage on current is fitted
RESISTANCE = 0.05, 0.05  # voltage drop at the usual current, as a share of the voltage: mean and sd over batteries
LASTS_S, FEWEST = 3.0, 3  # time beyond a limit, and samples of a voltage, before it is reported: a knock shakes for a second or two
PINNED = 0.995  # of the largest current
BEFORE_S, NEAR_S = 1.0, 1.5  # the usual voltage is taken up to BEFORE_S before a moment, the drop within NEAR_S of it


def fell(flight: Flight, moment: float) -> bool | None:
    """True if the voltage fell below SAG of its usual value within NEAR_S of `moment` s; None without enough samples."""
    if not flight.has("battery"):
        return None
    battery = flight["battery"]
    volts = np.where(battery.valid[:, 0], battery.values[:, 0], np.nan)
    usual, now = volts[battery.time < moment - BEFORE_S], volts[np.abs(battery.time - moment) < NEAR_S]
    if np.isfinite(usual).sum() < 3 or not np.isfinite(now).any() or np.nanmedian(usual) <= 0.0:
        return None
    return float(np.nanmin(now)) < SAG * float(np.nanmedian(usual))


def sagged(flight: Flight, moment: float) -> bool | None:
    """True if it fell there by more than its current explains; None where that is unknown."""
    if not fell(flight, moment):
        return fell(flight, moment)
    beyond = unexplained(flight, moment, moment - NEAR_S, moment + NEAR_S)
    return None if beyond is None else bool(beyond.max() > 0.0)


def unexplained(flight: Flight, moment: float, start: float, end: float) -> np.ndarray | None:
    """Voltage deficit [V] of each sample between `start` and `end` s, beyond its current and the limit SAG, by a fit to the flight before
    `moment` s; None where no current is logged.

    The fit is E + D t - R I: a controller that compensates a dead rotor draws twice the current, and the voltage sags by that."""
    battery = flight["battery"]
    time, volts = battery.time, np.where(battery.valid[:, 0], battery.values[:, 0], np.nan)
    before, now = time < moment - BEFORE_S, (time > start) & (time < end)
    usual = float(np.nanmedian(volts[before]))
    logged = battery.values.shape[1] > 1 and battery.valid[:, 1]
    amps = np.where(logged, battery.values[:, -1], np.nan)
    valid = np.isfinite(volts) & np.isfinite(amps)
    if (valid & before).sum() < 3 or not (valid & now).any() or not np.nanmedian(amps[before]) > 0.0:
        return None
    load = amps / np.nanmedian(amps[before])
    X = np.column_stack([np.ones(time.size), (time - moment) / BATTERY_S, -load])
    recent = valid & before & (time > moment - BATTERY_S)
    recent = recent if recent.sum() > 2 else valid & before
    noise = max(float(np.diff(volts[recent]).std()), 0.002 * usual)
    # Where the current has hardly changed, the resistance is not observable: its prior is RESISTANCE.
    mean, sd = np.array([usual, 0.0, RESISTANCE[0] * usual]), np.array([usual, usual, RESISTANCE[1] * usual])
    P = np.linalg.inv(X[recent].T @ X[recent] / noise**2 + np.diag(sd**-2.0))
    fit = P @ (X[recent].T @ volts[recent] / noise**2 + mean / sd**2)
    x = X[valid & now]
    least = x @ fit - 2.0 * np.sqrt(np.einsum("ij,jk,ik->i", x, P, x) + noise**2)
    return (SAG - 1.0) * usual + least - volts[valid & now]


def collapse(flight: Flight, air: Spans) -> tuple[float, float, float] | None:
    """(onset [s], lowest voltage, usual voltage [V]) of the first unexplained voltage drop in the flights `air` that lasted LASTS_S or to
    the flight's end; None where there was none, or it is unknown."""
    for start, end in air if flight.has("battery") else ():
        battery = flight["battery"].between(start, end)
        ok = battery.valid[:, 0]
        time, volts = battery.time[ok], battery.values[ok, 0]
        if time.size < FEWEST:
            continue
        second = np.floor(time - time[0]).astype(np.int64)
        most = np.full(int(second[-1]) + 1, 0.0)
        np.maximum.at(most, second, volts)
        recent = np.array([most[max(0, k - int(BATTERY_S)) : k + 1].max() for k in range(most.size)])
        low = volts < SAG * recent[second]
        edges = np.flatnonzero(np.diff(np.concatenate([[False], low, [False]])))
        for first, last in zip(edges[::2], edges[1::2] - 1):
            over = np.isfinite(end) and last == time.size - 1 and last - first >= FEWEST
            if time[last] - time[first] < LASTS_S and not over:
                continue
            moment = float(time[first])
            part = Flight("", "", {"battery": _measured(battery.between(moment - BATTERY_S, moment + LASTS_S))}, moment)
            if fell(part, moment) is None:
                continue
            beyond = unexplained(part, moment, moment - 1e-6, min(moment + LASTS_S, float(time[last]) + 1e-6))
            if beyond is not None and beyond.size >= FEWEST and float(median(beyond)) > 0.0:
                before = (time < moment - BEFORE_S) & (time > moment - BATTERY_S)
                return moment, float(volts[first : last + 1].min()), float(median(volts[before]))
    return None


def _measured(battery: Signal) -> Signal:
    """The battery without currents at the end of the sensor's range, where the true current may be larger."""
    if battery.values.shape[1] < 2 or not battery.valid[:, 1].any():
        return battery
    amps = np.where(battery.valid[:, 1], battery.values[:, 1], -np.inf)
    pinned = amps > PINNED * amps.max()
    valid = battery.valid.copy()
    valid[:, 1] &= ~(pinned & (pinned.sum() >= FEWEST))
    return battery.with_arrays(battery.time, battery.values, valid)
