"""How large a loss of each rotor can be that has not been announced.

What is not announced has been taken for a disturbance: from its onset on the estimated biases of roll, pitch and yaw hold what the rotor
does not give. A loss L of rotor i is a step of

    z = b / mean T      by      L B_i T_i / mean T

b: biases [hover thrusts of one rotor]; T: thrusts commanded; dividing by the mean takes a sagging battery out. For every onset between
two blocks of time L is weighted least squares on the difference of the means of z after and before it; the variance of z is enlarged by
(1 + r) / (1 - r) for errors of an autoregression with correlation r from block to block. The bound is the largest upper end of the 95 %
intervals over all onsets. Wind that turns, or a load that shifts, is such a step as well: the bound then says that
a loss could look like this. Thrust itself, which battery and air move for all rotors alike, is not asked.

Sources: G. V. Bayley and J. M. Hammersley, The effective number of independent observations in an autocorrelated time series, Supplement
to the Journal of the Royal Statistical Society 8 (1946) 184-197, for the enlargement; M. G. Kendall, Note on bias in the estimation of
autocorrelation, Biometrika 41 (1954) 403-404, for the (1 + 3 r) / N by which r comes out too small.
"""

from __future__ import annotations

import numpy as np

from rotorwatch.maths.tails import student_quantile
from rotorwatch.motion.ticks import JUDGE, Ticks

STEP_S = 2.0  # length of a block; a longer one hides the scatter of wind, a shorter one is as correlated as the wind is
BLOCKS = 8, 200  # at least, so that short flights have shorter ones, and at most
SPELL = 3  # blocks before and after an onset
CORRELATED = 0.9  # at most


def losses(biases: np.ndarray, table: Ticks, B: np.ndarray) -> np.ndarray:
    """Upper bound (n,) of what each rotor can have lost since judging began, beyond what was announced; 1 where too little was judged.

    biases (T, 4): as estimated, at the ticks of `table`; B (4, n): effectiveness.
    """
    use = (table.mode == JUDGE) & table.valid[:, :3].all(axis=1) & ~table.upset
    n, rows = B.shape[1], np.flatnonzero(use)
    if rows.size < 2 * BLOCKS[0]:
        return np.ones(n)
    T = table.thrust[rows]
    N = int(np.clip(rows.size * table.dt / STEP_S, *BLOCKS))
    starts = np.arange(N) * rows.size // N
    size = np.diff(starts, append=rows.size)[:, None]

    def mean(values):
        return np.add.reduceat(values, starts) / size

    usual = mean(T).mean(axis=1, keepdims=True)
    z, share = mean(biases[rows, :3]) / usual, mean(T) / usual
    onsets = range(SPELL, N - SPELL + 1)
    # The scatter is that about the step that explains most: about any other one, the step itself would count as scatter.
    left = min((_left(z, k) for k in onsets), key=lambda e: np.log(_squares(e)).sum())
    r = (left[1:] * left[:-1]).sum(axis=0) / _squares(left)
    r = np.clip(r + (1.0 + 3.0 * r) / N, 0.0, CORRELATED)
    variance = _squares(left) / (N - 2) * (1.0 + r) / (1.0 - r)
    reach, found = student_quantile(0.975, N - 2), np.zeros(n)
    for k in onsets:
        weight = 1.0 / (variance * (1.0 / k + 1.0 / (N - k)))
        columns = B[:3] * share[k:].mean(axis=0)
        information = np.maximum(weight @ columns**2, 1e-12)
        loss = weight * (z[k:].mean(axis=0) - z[:k].mean(axis=0)) @ columns / information
        found = np.maximum(found, np.maximum(loss, 0.0) + reach / np.sqrt(information))
    return np.minimum(found, 1.0)


def _left(z: np.ndarray, k: int) -> np.ndarray:
    """What is left of z (N, 3) about its means before and after block k."""
    return np.concatenate([z[:k] - z[:k].mean(axis=0), z[k:] - z[k:].mean(axis=0)])


def _squares(left: np.ndarray) -> np.ndarray:
    return np.maximum((left**2).sum(axis=0), 1e-12)
