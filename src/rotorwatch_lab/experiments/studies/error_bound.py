"""Theorem 1 of the intermediate observer's paper, compared with simulated errors: whether its bound holds, and how wide it is.

    V = e_x' e_x + mu e_tau' e_tau,   dV/dt <= -sigma |e|^2 + eta,   e = (e_x, e_tau),   e_tau = e_f - alpha E' e_x
    eta = epsilon (1 + mu alpha) theta_1^2 + mu epsilon theta_2^2,   sigma = lambda_min(-Sigma)

theta_1 bounds the disturbance xi, theta_2 the fault's rate. With mu = 1 the errors are at most those of dV/dt = -sigma V + eta that
starts where they do, and end within sqrt(eta / sigma). Both come out of simulated flights, without noise: the theorem knows of none.
xi is gyroscopic torque, the rotors' included, and lift that tilt turns away; the fault is what the rotors lack.

Source: Nguyen, Huynh, Do, Mung and Hong, Sensors 20 (2020) 4917, eqs. (15)-(29).
"""

from __future__ import annotations

import numpy as np

from rotorwatch_lab.experiments.studies.hover_flights import OBSERVER_HZ, Craft
from rotorwatch_lab.maths import intermediate_design as design

DT = 1.0 / OBSERVER_HZ
ROUNDING = 1e-3  # what sampled observers differ from continuous ones, against the largest error


def truth(vehicle: Craft, u, y, gamma) -> tuple[np.ndarray, np.ndarray]:
    """Signals unknown to the observer, (N, T, 4) each: fault f [rad/s^2, m/s^2 down] and disturbance xi. u (N, T, 4) counts, y (N, T, 8)
    measurements without noise, gamma (N, T, 4) losses."""
    DM = vehicle.D[:, None] * vehicle.M
    down = np.array([1.0, 1.0, 1.0, -1.0])
    fault = -(u * gamma) @ DM.T * down
    I_1, I_2, I_3 = 1.0 / vehicle.D[:3]
    p, q, r = y[..., 4], y[..., 5], y[..., 6]
    tilt = np.cos(y[..., 0]) * np.cos(y[..., 1]) - 1.0
    lift = (u * (1.0 - gamma)) @ DM[3]
    momentum = np.sqrt(u * (1.0 - gamma)) @ vehicle.spun  # J_r Omega
    roll, pitch, yaw = (I_2 - I_3) * q * r - momentum * q, (I_3 - I_1) * p * r + momentum * p, (I_1 - I_2) * p * q
    xi = [roll / I_1, pitch / I_2, yaw / I_3, -tilt * lift]
    return fault, np.stack(xi, axis=-1)


def compare(flights: dict, alpha: float, gains: tuple[float, float], epsilon: float) -> dict:
    """Name -> whether the bound is held at all times and how wide it is, for flights name -> (e_x (T, 8), e_f (T, 4), fault (T, 4), xi
    (T, 4), starts): starts are samples at which the fault jumps, after which the bound begins anew. mu = 1."""
    A, C, E = design.double_integrators()
    L = np.diag([gains[0]] * 4 + [gains[1]] * 4)
    out: dict = {"alpha": alpha, "epsilon": epsilon, "mu": 1.0, "flights": {}}
    out["sigma"] = design.bound(A, C, E, E, L, alpha, epsilon, 1.0, 0.0, 0.0).sigma
    for name, (e_x, e_f, fault, xi, starts) in flights.items():
        size = np.sqrt((e_x**2).sum(axis=1) + ((e_f - alpha * e_x @ E) ** 2).sum(axis=1))
        rate = np.linalg.norm(np.diff(fault, axis=0, prepend=fault[:1]), axis=1) / DT
        pushed = np.linalg.norm(xi, axis=1)
        held, limit = True, np.full(len(size), np.nan)
        for a, b in zip(starts, (*starts[1:], len(size))):
            limit[a:b] = _envelope(size[a] ** 2, rate[a:b], pushed[a:b], alpha, epsilon, out["sigma"])
            held &= bool((size[a:b] <= limit[a:b] + ROUNDING * size[a]).all())
        last = slice(starts[-1] + (len(size) - starts[-1]) // 2, None)
        theta = float(pushed[last].max()), float(rate[last].max())

        def radius(epsilon, theta=theta):
            return design.bound(A, C, E, E, L, alpha, epsilon, 1.0, *theta).radius

        best = min(radius(e) for e in np.geomspace(0.55 * (1 + alpha) / alpha, 100.0, 60) if radius(e) >= 0.0)
        error = float(size[last].max())
        out["flights"][name] = {
            "held": held, "theta_1": theta[0], "theta_2": theta[1], "bound": radius(epsilon), "bound_best_epsilon": best, "error": error,
            "times_too_wide": radius(epsilon) / max(error, 1e-12), "series": (size, limit),
        }  # fmt: skip
    return out


def _envelope(start: float, rate, pushed, alpha: float, epsilon: float, sigma: float) -> np.ndarray:
    """(T,) largest |e| by dV/dt = -sigma V + eta(t), V = start at the first sample; mu = 1."""
    eta = epsilon * ((1.0 + alpha) * pushed**2 + rate**2)
    left, V = np.exp(-sigma * DT), np.empty(len(eta))
    V[0] = start
    for k in range(1, len(eta)):
        V[k] = left * V[k - 1] + (1.0 - left) / sigma * max(eta[k], eta[k - 1])
    return np.sqrt(V)
