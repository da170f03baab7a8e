"""Huber's linear regression and mean: outliers count by their distance, not by its square.

    theta = argmin sum_i rho(y_i - X_i theta) + theta' P theta / 2,      weights w_i = min(1, BOUND s / |r_i|)

by reweighting (Huber, Robust Statistics, 1981, section 7.8), with the scale s = 1.4826 median |r| of a normal distribution.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.base.arrays import median

BOUND = 1.5  # residuals [s] beyond which weights fall
ROUNDS = 10  # of a mean


class Fit(NamedTuple):
    """theta (p,); residual (n,) y - X theta; scale, of the residuals."""

    theta: np.ndarray
    residual: np.ndarray
    scale: float


def weights(residual: np.ndarray, least: float = 1e-9) -> tuple[np.ndarray, np.ndarray]:
    """Weights of residuals (n, ...) and their scale (...) by the median, `least` more than that."""
    size = np.abs(residual)
    scale = 1.4826 * median(size, axis=0) + least
    return np.minimum(1.0, BOUND * scale / np.maximum(size, 1e-12)), scale


def mean(values: np.ndarray) -> np.ndarray:
    """Column means (d,) of values (n, d)."""
    centre = median(values, axis=0)
    for _ in range(ROUNDS):
        weight, _ = weights(values - centre)
        centre = np.sum(weight * values, axis=0) / np.sum(weight, axis=0)
    return centre


def regression(X: np.ndarray, y: np.ndarray, rounds: int = 4) -> Fit:
    """Regression of y (n,) on X (n, p). A constant is a column of ones. rounds: reweightings."""
    unit = np.sqrt(np.mean(X * X, axis=0))
    unit = np.where(unit > 0.0, unit, 1.0)  # of each column

    def solved(weighted: np.ndarray) -> np.ndarray:
        information = weighted.T @ X / np.outer(unit, unit)
        # For columns of zeros, or equal columns.
        information += np.diag(1e-12 * information.diagonal() + (information.diagonal() == 0.0))
        return np.linalg.solve(information, y @ weighted / unit) / unit

    theta, scale = solved(X), np.float64(0.0)
    for _ in range(rounds):
        weight, scale = weights(y - X @ theta)
        theta = solved(X * weight[:, None])
    return Fit(theta, y - X @ theta, float(scale))
