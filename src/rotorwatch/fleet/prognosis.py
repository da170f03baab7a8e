"""Time at which the loss of a wearing rotor reaches a limit.

The onset of wear is uncertain, so each possible onset k has its line: the present loss and its growth, jointly normal, and its probability
(`explain.lines`). The limit is reached before time t with the probability

    P(t) = sum_k p_k Phi((l_k + s_k t - LIMIT) / sd_k(t)),      sd_k(t)^2 = var l + 2 t cov(l, s) + t^2 var s

whose quantiles are the interval. For one line that is Fieller's. `answer/trend.py` does not apply: it is for errors that wander
within a flight, and would reject a trend that a hundred separate flights show. Correlation between flights is in their noise already.

Source: E. C. Fieller, Some problems in interval estimation, Journal of the Royal Statistical Society B 16 (1954) 175-185.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotorwatch.stats.tails import normal_cdf

LIMIT = 0.10  # loss
COVERED = 0.90
FAR = 20.0  # horizon, as a multiple of the hours flown so far
SURE_SD = 1.96


@dataclass(frozen=True)
class Lines:
    """Possible lines of a rotor's loss. weight (m,): sum 1. now, growth (m,): loss at the last flight, and per hour in the air. covariance
    (m, 2, 2): of the two."""

    weight: np.ndarray
    now: np.ndarray
    growth: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True)
class Prognosis:
    """word: growing, reached or no trend. growth, growth_interval: loss per hour in the air, 95 %. hours: in the air from the last flight
    until LIMIT, the median; interval: COVERED, its end None when beyond the horizon."""

    word: str
    growth: float = 0.0
    growth_interval: tuple[float, float] = (0.0, 0.0)
    hours: float | None = None
    interval: tuple[float, float | None] | None = None

    def to_dict(self) -> dict:
        """Plain data."""
        speed = {"loss_per_hour": self.growth, "loss_per_hour_interval": list(self.growth_interval), "limit": LIMIT}
        left = {"hours_left": self.hours, "hours_left_interval": list(self.interval) if self.interval else None}
        return {"word": self.word} | speed | left


def foresee(lines: Lines | None, flown: float) -> Prognosis:
    """lines: of a wearing rotor, None without wear. flown: hours in the air so far."""
    if lines is None:
        return Prognosis("no trend")
    w = lines.weight
    growth = float(w @ lines.growth)
    sd = float(np.sqrt(w @ (lines.covariance[:, 1, 1] + (lines.growth - growth) ** 2)))
    bounds = (growth - SURE_SD * sd, growth + SURE_SD * sd)
    if float(w @ lines.now) >= LIMIT:
        return Prognosis("reached", growth, bounds, 0.0, (0.0, 0.0))
    if bounds[0] <= 0.0:
        return Prognosis("no trend", growth, bounds)
    # Logarithmic, for equal relative resolution.
    t = np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 4000)]) * FAR * flown
    v = lines.covariance
    variance = v[:, 0, 0, None] + 2.0 * t * v[:, 0, 1, None] + t**2 * v[:, 1, 1, None]
    z = (lines.now[:, None] + lines.growth[:, None] * t - LIMIT) / np.sqrt(np.maximum(variance, 1e-18))
    reached = np.maximum.accumulate(w @ normal_cdf(z))
    shares = (0.5 - COVERED / 2, 0.5, 0.5 + COVERED / 2)
    low, middle, high = (float(t[np.argmax(reached >= q)]) if reached[-1] >= q else None for q in shares)
    if low is None or middle is None:
        return Prognosis("no trend", growth, bounds)
    return Prognosis("growing", growth, bounds, middle, (low, high))
