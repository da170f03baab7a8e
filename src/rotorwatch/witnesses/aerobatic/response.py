"""Response of angular acceleration to commands, for a vehicle that never hovers, and the residual torque.

    d omega_a / dt = k_a sum_i B_ai T_i + d_a omega_a + c_a omega_b omega_c + trim,       T_i = lag(f(u_i))

k_a: gain [rad/s^2 for the full thrust of a rotor on the longest arm]; d_a: damping; c_a: gyroscopic coupling; B: effectiveness of the
airframe; f: thrust curve; lag: first order, the motor's. All are fitted to the flight. Rotors change the rates within a tenth of a second,
trim and air more slowly, so only what is faster than a second is fitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.engine.motion.allocation import Spans, motor_thrusts, within
from rotorwatch.flight import Flight
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.stats import huber

WINDOW_S = 0.02
FAST_S = 1.0  # slower changes are trim and air
LAGS_S = (0.01, 0.015, 0.02, 0.03, 0.04, 0.06)
OTHERS = ((1, 2), (0, 2), (0, 1))
EDGE_S = 1.0  # after lift-off and before landing: the ground is near
LEAST = 250  # windows


class Response(NamedTuple):
    """K windows of 20 ms.

    time (K,) s, of their ends; thrust (K, n): share of full thrust, lagged; missing (K, 3): residual roll, pitch and yaw torque [full
    thrusts of a rotor on the longest arm], with trim; rate (K, 3) rad/s; flies (K,) bool. lag_s: of the motors; gain, damping, coupling
    (3,)."""

    time: np.ndarray
    thrust: np.ndarray
    missing: np.ndarray
    rate: np.ndarray
    flies: np.ndarray
    lag_s: float
    gain: np.ndarray
    damping: np.ndarray
    coupling: np.ndarray


def respond(flight: Flight, vehicle: Vehicle, air: Spans) -> Response | None:
    """The response of a flight's angular motion to its outputs; None where it flew too little, or an axis does not respond."""
    thrusts, gyro = motor_thrusts(flight, vehicle), flight.angular_rate()
    known = thrusts.whole
    if known.sum() < LEAST or gyro is None or gyro.whole.sum() < LEAST:
        return None
    time, share = thrusts.time[known], thrusts.values[known]
    rate = np.column_stack([np.interp(time, *_valid(gyro.time, gyro.values[:, a], gyro.valid[:, a])) for a in range(3)])
    edges = np.searchsorted(time, np.arange(time[0], time[-1], WINDOW_S))
    ends = time[0] + WINDOW_S * np.arange(1, len(edges))
    inner = tuple((start + EDGE_S, end - EDGE_S) for start, end in air)
    flies = within(ends, inner) & (np.diff(edges) > 0)
    if flies.sum() < LEAST:
        return None
    turning, motion = _derivative(rate, edges)
    B, best = vehicle.effectiveness(), None
    for lag, late in zip(LAGS_S, _lagged(share, float(median(np.diff(time))), LAGS_S)):
        thrust = _smooth(_means(late, edges))
        fits = [_fit(thrust @ B[a], turning[:, a], motion, a, flies) for a in range(3)]
        score = sum(np.log(scale) for _, scale in fits)
        if best is None or score < best[0]:
            best = score, lag, thrust, np.array([theta for theta, _ in fits])
    assert best is not None
    _, lag, thrust, theta = best
    gain, damping, coupling = theta.T
    if (gain <= 0.0).any():
        return None
    pulled = np.column_stack([motion[:, i] * motion[:, j] for i, j in OTHERS])
    missing = thrust @ B[:3].T - (turning - damping * motion - coupling * pulled) / gain
    return Response(ends, thrust, missing, motion, flies, lag, gain, damping, coupling)


def _valid(time: np.ndarray, values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return time[valid], values[valid]


def _lagged(share: np.ndarray, dt: float, lags: Sequence[float]) -> Iterator[np.ndarray]:
    """Thrusts (N, n) that follow commands dt s apart with each first-order lag, by the filter's frequency response."""
    size = 1 << (2 * len(share) - 1).bit_length()  # a prime length takes ten times as long
    spectrum, turn = np.fft.rfft(share, size, axis=0), 2j * np.pi * np.fft.rfftfreq(size, dt)
    for lag in lags:
        yield np.fft.irfft(spectrum / (1.0 + turn * lag)[:, None], size, axis=0)[: len(share)]


def _means(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Means of samples x (N, n) between edges (K + 1,)."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    return (total[edges[1:]] - total[edges[:-1]]) / np.maximum(np.diff(edges), 1)[:, None]


def _smooth(x: np.ndarray) -> np.ndarray:
    """The smoothing that `_derivative` applies to the motion: neighbours count half."""
    out = x.copy()
    out[1:-1] = 0.25 * x[:-2] + 0.5 * x[1:-1] + 0.25 * x[2:]
    return out


def _derivative(rate: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angular acceleration and rate (K, 3) of windows, from rates (N, 3) averaged over a window about each edge."""
    half = max(1, int(median(np.diff(edges))) // 2)
    total = np.concatenate([np.zeros((1, 3)), np.cumsum(rate, axis=0)])
    low, high = np.clip(edges - half, 0, len(rate) - 1), np.clip(edges + half, 1, len(rate))
    at = (total[high] - total[low]) / (high - low)[:, None]
    return np.diff(at, axis=0) / WINDOW_S, 0.5 * (at[1:] + at[:-1])


def _fast(x: np.ndarray) -> np.ndarray:
    """x (K, ...) without its mean over FAST_S about each window."""
    width = int(FAST_S / WINDOW_S) // 2
    total = np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])
    k = np.arange(len(x))
    low, high = np.maximum(k - width, 0), np.minimum(k + width, len(x))
    return x - (total[high] - total[low]) / (high - low).reshape(-1, *[1] * (x.ndim - 1))


def _fit(torque: np.ndarray, turning: np.ndarray, motion: np.ndarray, axis: int, flies: np.ndarray):
    """((gain, damping, coupling), scale of the residual) of one axis."""
    i, j = OTHERS[axis]
    X = _fast(np.column_stack([torque, motion[:, axis], motion[:, i] * motion[:, j]]))[flies]
    fit = huber.regression(X, _fast(turning)[flies])
    return fit.theta, fit.scale
