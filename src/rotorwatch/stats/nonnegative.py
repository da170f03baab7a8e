"""Least squares with unknowns that are not negative, and the best assignment of rows to columns: small exact problems."""

from __future__ import annotations

import numpy as np


def least_squares(A: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, float]:
    """x (n,) >= 0 that makes |A x - b| smallest, and that length; A (m, n).

    The active set method of C. L. Lawson and R. J. Hanson, Solving least squares problems (1974), chapter 23.
    """
    m, n = A.shape
    x, free = np.zeros(n), np.zeros(n, bool)
    small = 10.0 * np.finfo(float).eps * max(m, n) * max(float(np.abs(A).sum(axis=0).max(initial=0.0)), 1e-300)
    for _ in range(3 * max(n, 1)):
        slope = A.T @ (b - A @ x)
        held = np.where(free, -np.inf, slope)
        if free.all() or held.max() <= small * max(float(np.linalg.norm(b)), 1e-300):
            break
        free[int(np.argmax(held))] = True
        while True:
            s = np.zeros(n)
            s[free] = np.linalg.lstsq(A[:, free], b, rcond=None)[0]
            if not free.any() or s[free].min() > 0.0:
                break
            # On the way from x to s, as far as none becomes negative; what becomes 0 is held there.
            low = free & (s <= 0.0)
            step = float((x[low] / (x[low] - s[low])).min())
            x = x + step * (s - x)
            free &= x > 1e-14 * max(float(x.max()), 1e-300)
            x[~free] = 0.0
        x = s
    return x, float(np.linalg.norm(A @ x - b))


def best_total(worth: np.ndarray) -> float:
    """The largest sum of worth[k, order[k]] over all orders of n columns; worth (n, n), n up to about 12.

    Held and Karp's recursion: the best of the first rows with each set of columns.
    """
    n = len(worth)
    best = {0: 0.0}
    for row in range(n):
        after: dict[int, float] = {}
        for taken, total in best.items():
            for column in range(n):
                if not taken >> column & 1:
                    now = taken | 1 << column
                    value = total + float(worth[row, column])
                    if value > after.get(now, -np.inf):
                        after[now] = value
        best = after
    return best[(1 << n) - 1]
