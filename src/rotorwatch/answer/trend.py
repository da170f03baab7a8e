"""The slope of a straight line under errors that wander by an unknown amount, with its interval.

    y_k = a + b t_k + w_k + v_k,      w: a random walk with steps of variance s2,      v: white, of variance q s2 (`engine/drift/fit.py`)

the local-level model with a drift. For each q of a grid the slope is that of generalised least squares, Student's t with N - 2 degrees of
freedom, and the likelihood of q is the restricted one: a, b and log s2 integrated out with flat priors. The interval is that of the
mixture over the grid. Ordinary least squares would take correlated errors for as many independent ones, and be sure of slopes
that are none. Errors that are correlated but do not wander (an autoregression) make the interval wider than it need be, never narrower.

Source: A. C. Harvey, Forecasting, structural time series models and the Kalman filter (1989), section 2.3, for the model; D. A. Harville,
Bayesian inference for variance components using only error contrasts, Biometrika 61 (1974) 383-385, for the likelihood.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotorwatch.engine.drift.fit import DOUBT, WHITE
from rotorwatch.engine.drift.stretch import LEAST
from rotorwatch.errors import ConfigError
from rotorwatch.stats.tails import student_density, student_shares

COVERED, NORMAL = 0.95, 1.959964  # and that many standard deviations of a normal distribution
NOTHING = 1e-17  # weights that a sum of all does not show


class Slope(NamedTuple):
    """Per unit of time: the slope, and the ends of its 95 % interval."""

    slope: float
    low: float
    high: float

    @property
    def sd(self) -> float:
        """Standard deviation of a normal distribution with that interval."""
        return (self.high - self.low) / (2.0 * NORMAL)


def slope(time: np.ndarray, values: np.ndarray, step: float) -> Slope:
    """Slope of values (N,) at time (N,), means over blocks of length `step`, gaps allowed. Raises ConfigError for fewer than LEAST."""
    return slopes(time, np.asarray(values, float)[:, None], step)[0]


def slopes(time: np.ndarray, values: np.ndarray, step: float) -> list[Slope]:
    """The same of each column of values (N, m)."""
    time, y = np.asarray(time, float), np.asarray(values, float)
    N = len(y)
    if N < LEAST:
        raise ConfigError(f"A trend needs at least {LEAST} values, not {N}.")
    X = np.column_stack([np.ones(N), time - time.mean()])
    at = (time - time[0]) / step
    L = np.linalg.cholesky(  # (q, N, N); the 1, a level of its own, is lost in a
        np.minimum(at[:, None], at[None, :]) + np.multiply.outer(WHITE, np.eye(N)) + 1.0
    )
    white = np.linalg.solve(L, np.broadcast_to(np.column_stack([X, y]), (len(WHITE), N, 2 + y.shape[1])))
    Xw, yw = white[:, :, :2], white[:, :, 2:]
    information = Xw.transpose(0, 2, 1) @ Xw
    b = np.linalg.solve(information, Xw.transpose(0, 2, 1) @ yw)
    rest = np.maximum(np.sum((yw - Xw @ b) ** 2, axis=1), 1e-300)
    size = np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1) + 0.5 * np.linalg.slogdet(information)[1]
    fits = (np.log(DOUBT) * np.arange(len(WHITE)) - size)[:, None] - 0.5 * (N - 2) * np.log(rest)
    spread = np.maximum(np.sqrt(rest / (N - 2) * np.linalg.inv(information)[:, 1, 1, None]), 1e-150)
    weight = np.exp(fits - fits.max(axis=0))
    weight /= weight.sum(axis=0)
    return [_mixed(*columns, N - 2) for columns in zip(weight.T, b[:, 1].T, spread.T)]


def _mixed(weight: np.ndarray, mean: np.ndarray, spread: np.ndarray, freedom: int) -> Slope:
    """Mean and interval of a mixture of Student's t distributions."""
    counts = weight > NOTHING
    weight, mean, spread = weight[counts], mean[counts], spread[counts]

    def quantile(share: float, near: float) -> float:
        low, high = (mean - 1e3 * spread).min(), (mean + 1e3 * spread).max()
        at = float(weight @ (mean + near * spread))
        while True:  # Newton's steps, halves where one would leave the bracket
            z = (at - mean) / spread
            below = float(weight @ student_shares(z, freedom))
            low, high = (at, high) if below < share else (low, at)
            step = (share - below) / float((weight / spread) @ student_density(z, freedom))
            after = at + step if low < at + step < high else 0.5 * (low + high)
            if abs(after - at) <= 1e-10 * (spread.min() + abs(at)) or after in (low, high):
                return float(after)
            at = after

    tail = 0.5 * (1.0 - COVERED)
    # Of t itself, nearly: Abramowitz & Stegun, 26.7.5.
    near = NORMAL + (NORMAL**3 + NORMAL) / (4.0 * freedom)
    return Slope(float(weight @ mean), quantile(tail, -near), quantile(1.0 - tail, near))
