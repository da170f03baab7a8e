"""The order of the outputs, by the motion that follows them: for logs without the rate controller's output.

If output k drives rotor p_k, the torque about axis a is sum_k b_a[p_k] T_k, with b_a the row of the effectiveness and T_k the thrust of
output k less the common part and the trim. Every order p explains a share of the angular acceleration w_a,

    R_a^2(p) = max over lags of (b_a[p]^T S_a)^2 / (b_a[p]^T C b_a[p] |w_a|^2),     S_a = sum T w_a,   C = sum T T^T,

of which only gains above 0 count. A weak, stuck or missing rotor lowers the share of the true order, but that of the others as well.
"""

from __future__ import annotations

from itertools import combinations, permutations

import numpy as np

from rotorwatch.base.arrays import quantile
from rotorwatch.engine.motion.tick_table import Ticks

ALL_ORDERS = 6  # rotors up to which every order is tried; beyond, exchanges of two and rotations of the frame
LEAST_S, LATEST_S, TRIM_S = 15.0, 0.25, 1.0  # of flight; lags of motion behind commands; over which trim is removed
ALIKE_FOR, NOISE_S = (3, 0.2)  # neighbouring ticks with the same error; averaging time for the noise of a rate's change
LARGE = 3.0  # multiple of the usual size at which knocks are clipped
NATS, PART = (20.0, 4.0)  # required gain in log-likelihood of another order; and share of it in each half of the flight
FAILS, SHOWS = 0.35, 0.1  # share of an axis explained by the frame's order, relative to the other order; and the share explained by that
LOSES = 0.35  # share of the gain in log-likelihood that an axis may lose


def followed(table: Ticks, B: np.ndarray) -> tuple[int, ...] | None:
    """The rotor (0-based) whose torque follows each output, where that is another order than the frame's; None otherwise.

    B (4, n): effectiveness. The other order must explain an axis on which the frame's fails, and lose hardly anything on the others.
    """
    ok = (table.mode > 0) & table.valid[:, :3].all(axis=1) & ~table.upset
    if table.seen is not None:
        ok &= table.seen
    if ok.sum() * table.dt < LEAST_S:
        return None
    thrust, motion = (_shaken(x, ok, table.dt) for x in (table.thrust, table.rate_dot))
    thrust -= thrust.mean(axis=1, keepdims=True)
    lags, orders = range(max(2, round(LATEST_S / table.dt))), _orders(B.shape[1])
    alike = max(ALIKE_FOR, NOISE_S / table.dt)

    def explained(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """(p, 3) shares of the motion explained by the orders, and their log-likelihoods."""
        R2 = _shares(thrust[rows], motion[rows], B, orders, lags)
        return R2, -0.5 * ok[rows].sum() / alike * np.log1p(-R2)

    R2, nats = explained(slice(None))
    best = int(np.argmax(nats.sum(axis=1)))
    more, fails = nats[best] - nats[0], (R2[0] < FAILS * R2[best]) & (R2[best] > SHOWS)
    if more.sum() < NATS or more.min() < -LOSES * more.sum() or not fails.any():
        return None
    middle = int(np.searchsorted(ok.cumsum(), ok.sum() // 2))
    for rows in (slice(middle), slice(middle, None)):  # outputs do not change places in flight; external forces come and go
        part = explained(rows)[1].sum(axis=1)
        if part[best] < part[0] + NATS / PART:
            return None
    return tuple(int(k) for k in orders[best])


def _shares(thrust: np.ndarray, motion: np.ndarray, B: np.ndarray, orders: np.ndarray, lags: range) -> np.ndarray:
    """(p, 3): R_a^2 of the module's docstring, of thrusts (T, n) and angular accelerations (T, 3)."""
    power, C = np.maximum(np.sum(motion**2, axis=0), 1e-12), thrust.T @ thrust
    S = np.stack([thrust[: len(thrust) - lag].T @ motion[lag:] for lag in lags])  # (lags, n, 3)
    shares = []
    for axis in range(3):
        b = B[axis][orders]
        along = np.einsum("pk,lk->pl", b, S[:, :, axis]).max(axis=1)
        size = np.einsum("pk,kj,pj->p", b, C, b) * power[axis]
        shares.append(np.where(along > 0.0, along**2 / np.maximum(size, 1e-12), 0.0))
    return np.clip(np.stack(shares, axis=1), 0.0, 0.999)


def _orders(n: int) -> np.ndarray:
    """(p, n) candidate orders of n rotors, the frame's own first."""
    own = tuple(range(n))
    if n <= ALL_ORDERS:
        return np.array(list(permutations(own)))
    turns = [own[k:] + own[:k] for k in range(n)]
    swaps = [tuple(j if k == i else i if k == j else k for k in own) for i, j in combinations(own, 2)]
    return np.array([*turns, *swaps])


def _shaken(x: np.ndarray, ok: np.ndarray, dt: float) -> np.ndarray:
    """Columns of (T, k) less trim and averaged over noise, 0 where not `ok`, clipped to the usual size."""
    long, short = (np.ones(width) / width for width in (max(3, round(TRIM_S / dt)), max(1, round(NOISE_S / dt))))
    columns = []
    for column in x.T:
        column = np.where(ok, column, 0.0)
        column = np.where(ok, np.convolve(column, short, "same") - np.convolve(column, long, "same"), 0.0)
        most = LARGE * max(quantile(np.abs(column[ok]), 0.8), 1e-12)
        columns.append(np.clip(column, -most, most))
    return np.stack(columns, axis=1)
