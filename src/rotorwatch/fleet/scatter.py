"""Scatter of an aircraft's healthy flights, estimated from its flights, some of which are not healthy.

Estimated is the scatter of single flights about slow or rare changes: from the difference of each flight and the mean of its neighbours.
Wear is the same for both, and a step shows in one or two differences of many. Only the half of the differences that lie closest together
give the shape (the minimum covariance determinant), and the median of all gives the size, so that up to half of them may be steps. Single
outlying flights (a hung weight, a storm) are weighted down later: noise has Student's t distribution with NU degrees of freedom.

Source: P. J. Rousseeuw and K. Van Driessen, A fast algorithm for the minimum covariance determinant estimator, Technometrics 41 (1999)
212-223.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.stats.multivariate_t import squared_distance

NU = 5.0
# Assumed of flights: of a rotor's thrust, relative; of the centre of mass, arm lengths.
ROTOR_SD, CENTRE_SD = 0.02, 0.01
PRIOR_FLIGHTS = 10.0  # weight of the assumed scatter in a fleet, and of the fleet's for one of its aircraft
ROUNDS = 30
# {d: median of the squared distance of rows of d from t with NU degrees of freedom}: d times the median of F(d, NU).
MEDIAN = {3: 2.7214}
# Ratio of the scatter of a difference from the mean of two neighbours to a flight's.
OF_TWO = 1.5


def assumed(effectiveness: np.ndarray) -> np.ndarray:
    """(3, 3) covariance of w between flights of the effectiveness B (4, n), by ROTOR_SD and CENTRE_SD."""
    B = effectiveness[:3] / effectiveness.shape[1]
    return ROTOR_SD**2 * B @ B.T + np.diag([CENTRE_SD**2, CENTRE_SD**2, 1e-8])


def differences(y: np.ndarray) -> np.ndarray:
    """(K - 2, d): every flight but the first and last less the mean of its neighbours, scaled to a single flight's scatter."""
    return (y[1:-1] - 0.5 * (y[:-2] + y[2:])) / np.sqrt(OF_TWO)


def scale(rows: np.ndarray, within: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """(d, d): scale matrix of Student's t for `rows` (m, d), centred, with known noise `within` (m, d, d) of the single rows.

    prior (d, d) counts for PRIOR_FLIGHTS rows. The known noise is subtracted on average only, and at least a tenth of the prior is left."""
    m, d = rows.shape
    if not m:
        return prior
    known = np.median(within, axis=0)
    start = prior + known
    estimate = start
    half = m // 2 + 1
    for _ in range(ROUNDS):
        core = rows[np.argsort(squared_distance(rows, estimate)[0], kind="stable")[:half]]
        shape = (PRIOR_FLIGHTS * start + core.T @ core) / (PRIOR_FLIGHTS + len(core))
        size = float(np.median(squared_distance(rows, shape)[0])) / MEDIAN[d]
        estimate = (PRIOR_FLIGHTS * start + 0.5 * m * size * shape) / (PRIOR_FLIGHTS + 0.5 * m)
    estimate = estimate - known
    values, axes = np.linalg.eigh(0.5 * (estimate + estimate.T))
    return (axes * np.maximum(values, 0.1 * np.linalg.eigvalsh(prior).min())) @ axes.T


def alone(y: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(K,) weight of each flight before any explanation: 1 where one of the two before or after it agrees, small where none does, so that
    isolated flights count less, but not the sides of a step, nor wear. y (K, d), noise (K, d, d)."""
    K, d = y.shape
    least = np.full(K, np.inf)
    for off in (1, 2):
        if off >= K:
            break
        far, _ = squared_distance(y[off:] - y[:-off], noise[off:] + noise[:-off])
        least[off:] = np.minimum(least[off:], far)
        least[:-off] = np.minimum(least[:-off], far)
    least = np.where(np.isfinite(least), least, 0.0)
    return np.minimum((NU + d) / (NU + least), 1.0)
