"""Sums over windows of a long table, in memory that does not grow with it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

ROWS = 1 << 16  # processed at a time


def groups(low: np.ndarray, high: np.ndarray, most: int = ROWS) -> Iterator[slice]:
    """Slices of windows from row low (m,) up to row high (m,), both non-decreasing: as many windows at a time, at least one, as lie within
    `most` rows."""
    first = 0
    while first < len(low):
        last = max(first + 1, int(np.searchsorted(high, low[first] + most, side="right")))
        yield slice(first, last)
        first = last


def sums(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(m, k) sums of the rows of values (n, k) in such windows."""
    out = np.empty((len(low), values.shape[1]))
    for some in groups(low, high):
        begin, end = int(low[some.start]), int(high[some.stop - 1])
        total = np.zeros((max(end - begin, 0) + 1, values.shape[1]))
        np.cumsum(values[begin:end], axis=0, out=total[1:])
        out[some] = total[high[some] - begin] - total[low[some] - begin]
    return out
