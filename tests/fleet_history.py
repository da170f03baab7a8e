"""Histories of aircraft that never flew, as numbers: what `explain` and `assess` are asked about in tests."""

from __future__ import annotations

import numpy as np

from rotorwatch.fleet.attribution import Series


def columns(n: int) -> np.ndarray:
    """B (4, n) of a quad X or a hexa X, ArduPilot's numbers."""
    degrees = [45, -135, -45, 135] if n == 4 else [90, -90, -30, 150, 30, -150]
    spin = [1, 1, -1, -1] if n == 4 else [-1, 1, -1, 1, 1, -1]
    a = np.radians(degrees)
    scale = np.abs(np.concatenate([np.sin(a), np.cos(a)])).max()
    return np.stack([-np.sin(a) / scale, np.cos(a) / scale, np.array(spin, float), np.ones(n)])


def wrench(B: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """(K, 3): w of flights whose rotors have lost theta (K, n)."""
    f = 1.0 / (1.0 - theta)
    return f @ B[:3].T / f.sum(axis=1, keepdims=True)


SD = np.array([0.010, 0.010, 0.006])


def series(theta: np.ndarray, seed: int = 0, services=(), tails: bool = True, **more) -> Series:
    """Flights with those losses, scatter SD between them, and a level of its own."""
    K, n = theta.shape
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((K, 3)) * SD
    if tails:  # Student's t with 5 degrees of freedom, as the model has it
        noise /= np.sqrt(rng.chisquare(5, K) / 5)[:, None]
    B = columns(n)
    y = wrench(B, theta) + noise + 0.02 * rng.standard_normal(3)
    given = {"use": np.ones(K, bool)} | more
    return Series(y, np.tile(np.diag(SD**2) * 1.25, (K, 1, 1)), np.arange(K) / 60.0, B[:3] / n, services=services, **given)


def row(k: int, w: np.ndarray, n: int, aircraft: str = "A", **more) -> dict:
    """A flight as `Store.trims` yields it."""
    zero = [0.0, 0.0, 0.0]
    trim = {
        "share": [0.4] * n, "wrench": list(map(float, w)), "force": [0.0, 0.0], "slope": [0.0, 0.0], "slope_sd": [0.1, 0.1],
        "covariance": np.diag([1e-6] * 3).tolist(), "change": zero, "change_covariance": np.zeros((3, 3)).tolist(),
        "limited": [0.0] * n, "seconds": 30.0, "blocks": 20.0, "voltage": 15.0, "effectiveness": columns(n).tolist(), "doubt": "",
    }  # fmt: skip
    given = {
        "hash": f"{k:064x}", "ordinal": k + 1, "aircraft": aircraft, "utc": f"2026-{1 + k // 28:02d}-{1 + k % 28:02d}T10:00:00.000Z",
        "clock_us": 0, "count": None, "airborne_s": 60.0, "rotors": n, "frame": "quad X", "build": "one", "verdict": "healthy",
        "name": f"{k}.bin", "trim": trim,
    }  # fmt: skip
    return given | more
