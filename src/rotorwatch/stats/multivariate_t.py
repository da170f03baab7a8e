"""Statistics of flights compared with one another: Student's t of several variables and intervals on grids.

A row x of d numbers with scale matrix S and nu degrees of freedom has the density ~ |S|^-1/2 (1 + q / nu)^-((nu + d) / 2), q = x' S^-1 x.
q / d follows F(d, nu) (Hotelling), and a row's weight in a robust fit is (nu + d) / (nu + q).

Sources: K. L. Lange, R. J. A. Little and J. M. G. Taylor, Robust statistical modeling using the t distribution, Journal of the American
Statistical Association 84 (1989) 881-896, for the weights; A. Gelman et al., Bayesian Data Analysis, 3rd ed., section 3.6, for the
distribution of a new row.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from rotorwatch.stats.tails import f_tail


def squared_distance(rows: np.ndarray, scale: np.ndarray, more: Sequence | None = None) -> tuple[np.ndarray, np.ndarray]:
    """(m,) squared Mahalanobis distance of each row (m, d) under scale (d, d) or (m, d, d), and the determinant of the scale.

    more: d numbers or arrays (m,), added to the diagonal. By Gaussian elimination, of all rows at once: d is small, m large.
    """
    d = rows.shape[-1]
    x = [rows[..., i] for i in range(d)]
    S = [[scale[..., i, j] for j in range(i + 1)] for i in range(d)]
    distance, determinant = np.zeros(rows.shape[:-1]), np.ones(())
    for j in range(d):
        pivot = S[j][j] if more is None else S[j][j] + more[j]
        for i in range(j + 1, d):
            factor = S[i][j] / pivot
            x[i] = x[i] - factor * x[j]
            for k in range(j + 1, i + 1):
                S[i][k] = S[i][k] - factor * S[k][j]
        distance = distance + x[j] * x[j] / pivot
        determinant = determinant * pivot
    return distance, determinant


def density(rows: np.ndarray, scale: np.ndarray, dof: float, more: Sequence | None = None) -> np.ndarray:
    """(m,) t densities, but for a factor, of rows (m, d); scale and more as in `squared_distance`."""
    distance, determinant = squared_distance(rows, scale, more)
    return (1.0 + distance / dof) ** (-0.5 * (dof + rows.shape[-1])) / np.sqrt(determinant)


def tail(x: np.ndarray, scale: np.ndarray, dof: float) -> float:
    """Share of rows that lie at least as far out as x (d,)."""
    return f_tail(float(squared_distance(x, scale)[0]) / len(x), len(x), dof)


def weights(rows: np.ndarray, scale: np.ndarray, dof: float) -> np.ndarray:
    """(m,) weight of each row (m, d): about 1 for usual ones, small for those that stand out."""
    return (dof + rows.shape[-1]) / (dof + squared_distance(rows, scale)[0])


def predictive(rows: np.ndarray, prior: np.ndarray, worth: float) -> tuple[np.ndarray, float]:
    """Scale matrix and degrees of freedom of the t distribution of a new row less the mean of `rows` (m, d), which update an inverse
    Wishart prior of mean `prior` (d, d) that counts for `worth` rows."""
    m, centred = len(rows), rows - rows.mean(axis=0)
    dof = worth + m + 1.0
    return (worth * prior + centred.T @ centred) / dof * (1.0 + 1.0 / m), dof


def weighted_mean(values: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Column means (d,) of values (m, d), each weighed with one over its variance (m, d), and the variance of the means."""
    precision = 1.0 / variance
    return (precision * values).sum(axis=0) / precision.sum(axis=0), 1.0 / precision.sum(axis=0)


def mean_and_interval(values: np.ndarray, mass: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Mean and 95 % interval of a distribution that has `mass` (g,), of any sum, at `values` (g,)."""
    order = np.argsort(values)
    values, mass = values[order], mass[order]
    total = np.cumsum(mass)
    low, high = (values[min(np.searchsorted(total, q * total[-1]), len(values) - 1)] for q in (0.025, 0.975))
    return float(np.sum(values * mass) / total[-1]), (float(low), float(high))


@functools.cache
def centred_grid(sd: float, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (g, 2) of a square grid to `reach` standard deviations, their distances from the middle and normal mass (g,), sum 1."""
    step = np.linspace(-reach, reach, 61) * sd
    points = np.stack([g.ravel() for g in np.meshgrid(step, step)], axis=1)
    distance = np.hypot(*points.T)
    mass = np.exp(-0.5 * (distance / sd) ** 2)
    return points, distance, mass / mass.sum()
