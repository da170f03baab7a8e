"""Huber's linear regression: outliers count by their distance, not by its square.

    theta = argmin sum_i rho(y_i - X_i theta) + theta' P theta / 2,      weights w_i = min(1, BOUND s / |r_i|)

by reweighting (Huber, Robust Statistics, 1981, section 7.8), with the scale s = 1.4826 median |r| of a normal distribution.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

BOUND = 1.5  # residuals [s] beyond which weights fall


class Fit(NamedTuple):
    """theta (p,); residual (n,) y - X theta; scale, of the residuals; covariance (p, p) of theta."""

    theta: np.ndarray
    residual: np.ndarray
    scale: float
    covariance: np.ndarray


def huber(X: np.ndarray, y: np.ndarray, precision=0.0, alike: float = 1.0, rounds: int = 4) -> Fit:
    """Regression of y (n,) on X (n, p). A constant is a column of ones.

    precision: (p,) of a normal prior about zero; 0: none. alike: so many neighbouring rows are worth one. rounds: reweightings.
    """
    unit = np.sqrt(np.mean(X * X, axis=0))
    unit = np.where(unit > 0.0, unit, 1.0)  # of each column
    Z, prior = X / unit, np.diag(np.broadcast_to(precision, unit.shape) / unit**2)
    theta = np.linalg.lstsq(Z, y, rcond=None)[0]
    residual = y - Z @ theta
    for _ in range(rounds):
        scale = 1.4826 * float(np.median(np.abs(residual))) + 1e-9
        weighted = (
            Z * (np.minimum(1.0, BOUND * scale / np.maximum(np.abs(residual), 1e-12)) / (alike * scale**2))[:, None]
        )
        information = weighted.T @ Z + prior
        information += np.diag(
            1e-12 * information.diagonal() + (information.diagonal() == 0.0)
        )  # columns of zeros, or alike
        theta = np.linalg.solve(information, weighted.T @ y)
        residual = y - Z @ theta
    return Fit(theta / unit, residual, scale, np.linalg.inv(information) / np.outer(unit, unit))
