"""Innovations of the angular motion and the motor speeds, in windows of 4 ms: what commands and the past do not predict.

    y_k = sum_l answer_l x_{k-l} + sum_l past_l y_{k-l} + motion + e_k

y: angular acceleration of an axis (x: its torque, sum_i B_ai T_i) or speed of a motor (x: root of its thrust), an autoregression with
inputs fitted to the flight. Motors respond late, so that a controller's reaction to an innovation comes after it: unlike torque over
acceleration at the same time, which reads a reaction to the air as a weak motor, this fit stays consistent in closed loop (Ljung, System
Identification, 2nd ed., 13.4).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.motion.allocation import Spans, motor_thrusts, within
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.stats import huber

WIDTH_S = 0.004
LEAST_HZ = 90.0  # sample rate; slower logs do not resolve 30 ms
LAGS, PAST = 14, 10  # windows: 56 and 40 ms
LEAST_S = 8.0  # of flight
EDGE_S = 0.5  # after lift-off and before landing
LOCAL_S = 1.0  # the air changes: innovations are compared with those within this time
CALMEST = 0.6  # of the flight's scale
DOF, QUARTILE = 7.0, 0.711  # of Student's t
TURNING_S = 0.05  # time constant of motors, from idle longer than the fit gives
UNSURE = 1.0  # share of the change that is uncertain until then
SPEEDS = 0.7  # share of the time for which a motor's speed must be reported


class Channel(NamedTuple):
    """K windows of an axis or of a motor's speed. rotor: the motor, None for an axis.

    time (K,) s, of their beginnings; width s; flies (K,) bool; thrust (K, n): commanded share of full thrust, without lag; left (K,):
    innovations over their scale; scale (K,): of y; drive (K, n): each rotor's part of x; answer (LAGS,)."""

    rotor: int | None
    time: np.ndarray
    width: float
    flies: np.ndarray
    thrust: np.ndarray
    left: np.ndarray
    scale: np.ndarray
    drive: np.ndarray
    answer: np.ndarray


def channels(flight: Flight, vehicle: Vehicle, air: Spans) -> list[Channel]:
    """The three axes, and the motors whose speed is logged; empty where the log is too slow or too short."""
    gyro = flight.angular_rate()
    if gyro is None or not flight.has("motors"):
        return []
    thrusts = motor_thrusts(flight, vehicle)
    known = thrusts.whole
    if known.sum() < 100 or gyro.whole.sum() < 100:
        return []
    time, share = thrusts.time[known], thrusts.values[known]
    dt = float(median(np.diff(time)))
    if not 0.0 < dt < 1.0 / LEAST_HZ or gyro.rate_hz < LEAST_HZ:
        return []
    width = max(WIDTH_S, 1.01 * dt)
    edges = np.searchsorted(time, np.arange(time[0], time[-1], width))
    thrust = means(share, edges)
    start = time[0] + width * np.arange(len(edges) - 1)
    inner = tuple((a + EDGE_S, b - EDGE_S) for a, b in air)
    there = np.diff(edges) > 0
    flies = within(start, inner) & there
    if flies.sum() * width < LEAST_S:
        return []
    rate = np.column_stack([np.interp(time, gyro.time[ok], gyro.values[ok, a]) for a, ok in enumerate(gyro.valid.T)])
    rate = means(rate, edges)
    turning = np.diff(rate, axis=0, append=rate[-1:]) / width
    B = vehicle.effectiveness()[:3]
    out = []
    for a in range(3):
        others = rate[:, (a + 1) % 3] * rate[:, (a + 2) % 3]
        motion = np.column_stack([np.ones(len(rate)), rate[:, a], others])
        fit = _surprise(turning[:, a], thrust * B[a], motion, flies, width)
        if fit is None:
            return []
        out.append(Channel(None, start, width, flies, thrust, *fit[:2], thrust * B[a], fit[2]))
    return out + _speeds(flight, start, width, flies, thrust)


def means(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Means of samples x (N, n) between edges (K + 1,); where there are none, the sample before."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    count = np.diff(edges)
    held = x[np.clip(edges[:-1] - 1, 0, len(x) - 1)]
    return np.where(count[:, None] > 0, (total[edges[1:]] - total[edges[:-1]]) / np.maximum(count, 1)[:, None], held)


def _speeds(flight: Flight, start: np.ndarray, width: float, flies: np.ndarray, thrust: np.ndarray) -> list[Channel]:
    """A channel for each motor whose speed follows its command."""
    esc, out, n = flight.signals.get("esc"), [], thrust.shape[1]
    if esc is None or esc.rate_hz < LEAST_HZ:
        return out
    for i in range(n):
        if f"speed{i + 1}" not in esc.columns:
            continue
        column = esc.columns.index(f"speed{i + 1}")
        ok = esc.valid[:, column]
        inside = within(esc.time, ((start[0], start[-1]),))
        if not inside.any() or ok[inside].mean() < SPEEDS:
            continue
        speed = np.interp(start + 0.5 * width, esc.time[ok], esc.values[ok, column])
        drive = np.zeros_like(thrust)
        drive[:, i] = np.sqrt(np.maximum(thrust[:, i], 0.0))
        fit = _surprise(speed, drive, np.ones((len(start), 1)), flies, width)
        if fit is not None:
            out.append(Channel(i, start, width, flies, thrust, *fit[:2], drive, fit[2]))
    return out


def _late(x: np.ndarray, lags: range) -> np.ndarray:
    """(K, lags): x (K,) delayed by each number of windows in `lags`."""
    return np.column_stack([np.concatenate([np.full(lag, x[0]), x[: len(x) - lag]]) for lag in lags])


def _surprise(y, drive, motion, flies, width) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """(left, scale (K,), answer (LAGS,)) of one channel with drive (K, n). None where nothing moves."""
    X = np.column_stack([_late(drive.sum(axis=1), range(LAGS)), _late(y, range(1, PAST + 1)), motion])
    if not np.ptp(y[flies]) > 0.0:
        return None
    fitted = huber.regression(X[flies], y[flies]).theta
    left = y - X @ fitted
    left[~flies] = 0.0
    scale = np.hypot(_scale(np.abs(left), flies, width), _unsure(drive, fitted[:LAGS], width))
    return left / scale, scale, fitted[:LAGS]


def _unsure(drive: np.ndarray, answer: np.ndarray, width: float) -> np.ndarray:
    """(K,) uncertainty of y while motors are still changing to the commanded speed."""
    total = np.zeros(len(drive))
    for turning in (UNSURE * (drive - _slow(drive, width))).T:
        total += np.convolve(turning, answer)[: len(total)] ** 2
    near = np.ones(LAGS // 2) / (LAGS // 2)
    return np.sqrt(np.convolve(total, near, "same"))


def _slow(x: np.ndarray, width: float) -> np.ndarray:
    """x (K, n) with a lag of TURNING_S, by its impulse response down to 1e-9."""
    keep = np.exp(-width / TURNING_S)
    response = (1.0 - keep) * keep ** np.arange(round(20.0 * TURNING_S / width))
    return x[0] + np.column_stack([np.convolve(column, response)[: len(x)] for column in (x - x[0]).T])


def _scale(error: np.ndarray, flies: np.ndarray, width: float) -> np.ndarray:
    """(K,) scale of Student's t: that within LOCAL_S, at least CALMEST of the flight's, by medians."""
    overall = float(median(error[flies])) / QUARTILE
    half = max(1, round(0.5 * LOCAL_S / width))
    blocks = len(error) // half + 1
    padded = np.full(blocks * half, np.nan)
    padded[: len(error)] = np.where(flies, error, np.nan)
    table = padded.reshape(blocks, half)
    at, values = np.arange(blocks), np.full(blocks, overall)
    for k in at:
        near = table[max(0, k - 1) : k + 2]
        near = near[np.isfinite(near)]
        if len(near) >= half:
            values[k] = max(CALMEST * overall, float(median(near)) / QUARTILE)
    return np.interp(np.arange(len(error)), (at + 0.5) * half, values)
