"""The balance of torques and of thrust at any attitude: how well a set of commands explains the motion of a tumbling vehicle.

For each axis a of roll, pitch and yaw, in the body frame,

    w_a + b_a = J_a (dr_a/dt + g_a) + D_a r_a + e,        w = B T

w: torque of the rotors' thrusts T (n,) (hover thrust of one rotor = 1); r: rates; g: gyroscopic terms of a flat body, (q r, -p r, 0) k; J,
D, b: inertia, damping and offset, with priors on their signs and sizes that hold for any multirotor: inertia is never negative, so that
motion against the torque contradicts the commands, however wrong the gains may be. For the thrust

    sum T - m load = e

with the load factor and the number of hover thrusts m that carry the vehicle. It holds while tumbling as well as in hover, unlike the
small-angle hover physics of `default`. The noise e is model error: thrust is off by a share, a rotor near its limit gives less (never
zero), slowly logged commands are snapshots. A share of all ticks carries no information (a blow, a damaged sample).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median
from rotorwatch.base.physics import G0
from rotorwatch.engine.spin import subsets
from rotorwatch.engine.spin.subsets import FLAT, OUTLIER_SD, OUTLIERS

# Inertia per rotor and its scatter in hover thrusts per rad/s^2, as in `default.plant`, but always positive.
# Ratios scatter, not differences: half the usual inertia is as far off as twice of it.
INERTIA, LIGHTER_SD, HEAVIER_SD, LEAST = (
    np.array(subsets.INERTIA),
    np.array([0.003, 0.003, 0.06]),
    np.array([0.006, 0.006, 0.1]),
    np.array([0.001, 0.001, 0.02]),
)
DAMPING_SD = np.array([0.03, 0.03, 0.2])  # hover thrusts per rad/s and rotor
# Standard deviations: hover thrusts of one rotor; share of each rotor's thrust; of a command that changes, of its step within the tick; of
# damping and gyroscopic terms; of the whole thrust, which air that flows along the axis changes; of the load factor, by drag.
FLOOR, THRUST_SHARE, STEP_SHARE, MOTION_SHARE, LOAD_SHARE, LOAD_FLOOR = 0.07, 0.08, 0.35, 0.3, 0.1, 0.1
BELOW_LIMIT, AT_LIMIT = 0.6, 0.95  # shares of full thrust between which ever less of the command is delivered:
LACKS, LACKS_SD = 0.15, 0.15  # deficit at the limit: hardly more than 40 %, and never negative
SPIN_UP_S = 0.05  # reaction torque of a rotor that speeds up: that of its thrust's change in this time
STRANGE_S = 1.0  # after the onset: the inflow of the rotors of a tumbling vehicle becomes ever less regular
FALLS_S = 0.4  # the same for thrust: a vehicle that falls or climbs meets other inflow at once
ERROR_S = 0.15  # correlation time of model errors: closer ticks count less
TURNS = 12  # of the coordinate descent
FALLS = 14.0  # m/s: the air carries up to about the whole weight of a vehicle that sinks this fast


class Window(NamedTuple):
    """K ticks: time (K,); thrust (K, n) commanded, in hover thrusts; full (float): a rotor's largest thrust; rate, rate_dot (K, 3); load
    (K,); torque_ok (K, 3), load_ok (K,) bool; before, after (K, n): commands of the adjacent ticks; onset: when control began to be lost
    [s]."""

    time: np.ndarray
    thrust: np.ndarray
    full: float
    rate: np.ndarray
    rate_dot: np.ndarray
    load: np.ndarray
    torque_ok: np.ndarray
    load_ok: np.ndarray
    before: np.ndarray
    after: np.ndarray
    onset: float = np.inf


class Offset(NamedTuple):
    """b of each axis: mean (3,) and standard deviation (3,) [hover thrusts]."""

    mean: np.ndarray
    sd: np.ndarray


class Fit(NamedTuple):
    """log_evidence (H,); residual (H, K, 4) in standard deviations."""

    log_evidence: np.ndarray
    residual: np.ndarray


def delivered(window: Window) -> np.ndarray:
    """(K, n) thrust of healthy rotors, in hover thrusts: less than commanded near their limit."""
    return (1.0 - LACKS * _near(window)) * window.thrust


def _near(window: Window) -> np.ndarray:
    return np.clip((window.thrust / window.full - BELOW_LIMIT) / (AT_LIMIT - BELOW_LIMIT), 0.0, 1.0)


def _step(window: Window) -> float:
    """Usual time between two ticks [s]; inf for a single tick."""
    return float(median(np.diff(window.time))) if window.time.size > 1 else np.inf


def noise_variance(window: Window, B: np.ndarray, air: np.ndarray) -> np.ndarray:
    """(K, 4) variance of e, as far as it depends on commands alone. B (4, n); air (K,): load carried by the air."""
    T = window.thrust
    change = 0.5 * (np.abs(window.after - T) + np.abs(T - window.before))
    each = (THRUST_SHARE * T) ** 2 + (STEP_SHARE * change) ** 2 + (LACKS_SD * _near(window) * T) ** 2
    variance = FLOOR**2 + each @ (B**2).T
    variance[:, 2] += (SPIN_UP_S / _step(window) * change) ** 2 @ B[2] ** 2
    whole = T.sum(axis=1) + STEP_SHARE / LOAD_SHARE * change.sum(axis=1)
    variance[:, 3] += (LOAD_SHARE * whole) ** 2 + (LOAD_FLOOR * B.shape[1]) ** 2 + (B.shape[1] * air) ** 2
    late = np.maximum(window.time - window.onset, 0.0)[:, None] / [STRANGE_S, STRANGE_S, STRANGE_S, FALLS_S]
    variance *= 1.0 + late**2
    return variance


def _air(window: Window) -> np.ndarray:
    """(K,) load factor that the air carries of a falling vehicle; its uncertainty is as large."""
    falls = np.where(window.load_ok & (window.time > window.onset), np.maximum(1.0 - window.load, 0.0), 0.0)
    step = np.diff(window.time, prepend=window.time[0])
    return 0.5 * np.minimum((G0 * np.cumsum(falls * step) / FALLS) ** 2, 1.0)


def fit(window: Window, wrench: np.ndarray, B: np.ndarray, offset: Offset) -> Fit:
    """Fit of H time series of the wrench (H, K, 4) to the motion.

    Per axis the most probable (J, D, b) by reweighted coordinate descent, for all series at once; the evidence is the mixture's likelihood
    there, times the prior."""
    n = B.shape[1]
    H, K, _ = wrench.shape
    air = _air(window)
    base = noise_variance(window, B, air)
    r = window.rate
    spin = FLAT * np.stack([r[:, 1] * r[:, 2], -r[:, 0] * r[:, 2], np.zeros(K)], axis=1)
    turn = window.rate_dot + spin
    mean = np.concatenate([(n * INERTIA)[:, None], np.zeros((3, 1)), offset.mean[:, None]], axis=1)
    sides = [
        np.concatenate([(n * side)[:, None], (n * DAMPING_SD)[:, None], offset.sd[:, None]], axis=1) for side in (LIGHTER_SD, HEAVIER_SD)
    ]
    low = np.concatenate([(n * LEAST)[:, None], np.zeros((3, 1)), np.full((3, 1), -np.inf)], axis=1)
    # Axes first: the sums over all ticks are then matrix products.
    X = np.stack([turn.T, r.T, -np.ones((3, K))])  # (3 parameters, 3 axes, K)
    pairs = np.stack([X[i] * X[j] for i in range(3) for j in range(3)], axis=2)  # (3 axes, K, 9)
    each = X.transpose(1, 2, 0)  # (3 axes, K, 3 parameters)
    squares = MOTION_SHARE**2 * np.stack([spin.T**2 + (0.3 * turn.T) ** 2, r.T**2], axis=1)  # (3 axes, 2, K)
    ok = np.ascontiguousarray(window.torque_ok.T)[:, None]
    y = np.ascontiguousarray(wrench[:, :, :3].transpose(2, 0, 1))  # (3 axes, H, K)
    usual = base.T[:3, None]
    p = np.broadcast_to(mean[:, None], (3, H, 3)).copy()
    weight = np.broadcast_to(np.where(ok, 1.0 / usual, 0.0), (3, H, K))
    e = variance = y
    for _ in range(TURNS):
        information = (weight @ pairs).reshape(3, H, 3, 3)
        score = (weight * y) @ each
        for j in range(3):
            sd = np.where(p[:, :, j] < mean[:, None, j], sides[0][:, None, j], sides[1][:, None, j])
            below = information[:, :, j, j]
            top = score[:, :, j] - (information[:, :, j] * p).sum(axis=2) + below * p[:, :, j] + mean[:, None, j] / sd**2
            p[:, :, j] = np.maximum(top / (below + 1.0 / sd**2), low[:, None, j])
        e = y - p @ each.transpose(0, 2, 1)
        variance = usual + p[:, :, :2] ** 2 @ squares
        rare = variance / (OUTLIER_SD**2 + variance)  # of an outlier's variance
        odds = np.sqrt(rare) * np.exp(np.minimum(0.5 * e**2 / variance * (1.0 - rare), 50.0))
        weight = np.where(ok, 1.0 / ((1.0 + OUTLIERS / (1.0 - OUTLIERS) * odds) * variance), 0.0)
    inside, outside = _normal(e, variance), _normal(e, OUTLIER_SD**2 + variance)
    torque = np.logaddexp(np.log(1.0 - OUTLIERS) + inside, np.log(OUTLIERS) + outside)
    weight_of = min(1.0, _step(window) / ERROR_S)
    total = weight_of * np.where(ok, torque, 0.0).sum(axis=(0, 2))
    away = p - mean[:, None]
    total -= 0.5 * ((away / np.where(away < 0.0, *(side[:, None] for side in sides))) ** 2).sum(axis=(0, 2))
    push = wrench[:, :, 3] - n * (window.load - air)[None]
    spread = np.broadcast_to(base[None, :, 3], (H, K))
    lift = np.logaddexp(np.log(1.0 - OUTLIERS) + _normal(push, spread), np.log(OUTLIERS) + _normal(push, (n * OUTLIER_SD) ** 2))
    total += weight_of * np.where(window.load_ok[None], lift, 0.0).sum(axis=1)
    torques = (e / np.sqrt(variance)).transpose(1, 2, 0)
    residual = np.concatenate([torques, (push / np.sqrt(spread))[:, :, None]], axis=2)
    return Fit(total, residual)


def _normal(e: np.ndarray, variance) -> np.ndarray:
    return -0.5 * (e**2 / variance + np.log(2.0 * np.pi * variance))
