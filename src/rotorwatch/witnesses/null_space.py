"""The null space of a geometry, and the noise of the thrust that an excitation within it is seen in.

With more rotors than channels there are commands N c with B N = 0: added to the commands of a healthy vehicle they move nothing
(`rotorwatch_lab/control/excitation.py` designs such excitations, `excitation_response.py` reads the answers to them).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

Array = Any
FLAT = 1e-9  # of the largest singular value: what counts as no effect
OPEN = 1e4  # variance of an unknown level


class Noise(NamedTuple):
    """What the commanded thrust less the load factor varies by without any loss, in hover thrusts of one rotor. variances (4,): white from
    tick to tick; two disturbances of time constants tau (2,) [s]; a random walk, per second. As the default diagnosis learns them
    (engine/estimator/noise.py)."""

    variances: Array
    tau: Array


def null_space(B: Array) -> np.ndarray:
    """N (n, k) with B N = 0 and N'N = 1: commands of equal size that move nothing. B (4, n). k = 0 where there are none."""
    B = np.asarray(B, float)
    rows = np.linalg.norm(B, axis=1, keepdims=True)
    _, values, right = np.linalg.svd(B / np.where(rows > 0.0, rows, 1.0))
    return right[int((values > FLAT * values.max(initial=0.0)).sum()) :].T


def covariance(noise: Noise, ticks: int, dt: float) -> np.ndarray:
    """Sigma (T, T) of the noise over T ticks, its level unknown."""
    white, first, second, walk = np.asarray(noise.variances, float)
    t = dt * np.arange(ticks)
    lag = np.abs(t[:, None] - t[None, :])
    both = first * np.exp(-lag / noise.tau[0]) + second * np.exp(-lag / noise.tau[1])
    return white * np.eye(ticks) + both + walk * np.minimum(t[:, None], t[None, :]) + OPEN * (white + first + second)
