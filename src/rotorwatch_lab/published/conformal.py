"""Intervals that hold, whatever a method's covariance says: split conformal calibration (Vovk, Gammerman and Shafer, Algorithmic Learning
in a Random World, 2005; Angelopoulos and Bates, arXiv:2107.07511).

The score of a step is the largest |error| over half-width of the method's own interval or set, over all rotors; the factor, the
ceil((n + 1)(1 - miss))-th smallest score of one step drawn from each of n flights. Intervals widened by it hold all losses of a step of
another flight with a probability of at least 1 - miss, if the flights are exchangeable. `FACTORS` is made by benchmarks/intervals.py, by
method, number of rotors and step.
"""

from __future__ import annotations

import csv
import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rotorwatch.errors import ConfigError
from rotorwatch.flight.method_series import MethodSeries

FACTORS = Path(__file__).with_name("conformal.csv")
MISS = 0.05
DRAWS = 501


def scores(series: MethodSeries, true: np.ndarray) -> np.ndarray:
    """(T,) factor by which the interval or set must widen to hold all true losses (T, n) of a step; inf where it has no width."""
    error = np.abs(series.theta - true)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(error > 0.0, error / series.theta_off, 0.0).max(axis=1)


def factor(flights: Sequence[np.ndarray], miss: float = MISS) -> float:
    """The conformal factor for the scores of n flights: the median over draws of one step from each, so that it hangs on no single draw.
    inf where n is too small to promise 1 - miss."""
    n = len(flights)
    k = int(np.ceil((n + 1) * (1.0 - miss) - 1e-9))
    if k > n:
        return float("inf")
    rng = np.random.default_rng(0)
    drawn = np.array([one[rng.integers(len(one), size=DRAWS)] for one in flights])
    return float(np.median(np.partition(drawn, k - 1, axis=0)[k - 1]))


@functools.cache
def factors() -> dict[tuple[str, int, float], float]:
    """(method, rotors, step s) -> factor."""
    with open(FACTORS, newline="", encoding="utf-8") as file:
        return {(row["method"], int(row["rotors"]), float(row["step_s"])): float(row["factor"]) for row in csv.DictReader(file)}


def calibrated(series: MethodSeries) -> MethodSeries:
    """The series with intervals that hold. Raises ConfigError for a method, a number of rotors or a step that was not calibrated."""
    key = (series.method, len(series.rotors), round(series.dt, 6))
    known = factors()
    if key not in known:
        steps = sorted({f"{n} rotors in steps of {dt:g} s" for name, n, dt in known if name == key[0]})
        raise ConfigError(
            f"{key[0]} is not calibrated for {key[1]} rotors in steps of {key[2]:g} s"
            + (f", only for {', '.join(steps)}" if steps else f"; calibrated are {', '.join(sorted({name for name, *_ in known}))}")
            + "; leave --calibrated out."
        )
    return replace(series, factor=known[key])
