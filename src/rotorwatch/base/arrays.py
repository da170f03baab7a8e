"""NumPy functions for small arrays, without NumPy's overhead per call and its imports."""

from __future__ import annotations

from typing import Any

import numpy as np


def median(values: Any, axis: int | None = None) -> Any:
    """`np.median`, bit for bit; NaN with a NaN among the values, and for no values."""
    values = np.asarray(values)
    if values.dtype.kind != "f":
        values = values.astype(float)
    if axis is None:
        values, axis = values.reshape(-1), 0
    count = values.shape[axis]
    if not count:
        return np.median(values, axis)
    middle = count // 2
    ordered = np.partition(values, (middle, count - 1) if count % 2 else (middle - 1, middle, count - 1), axis)
    middle_value = ordered.take(middle, axis)
    if count % 2 == 0:
        middle_value = (ordered.take(middle - 1, axis) + middle_value) / 2
    lacks = np.isnan(last := ordered.take(count - 1, axis))  # sorted behind all numbers
    return np.where(lacks, last, middle_value)[()] if lacks.any() else middle_value


def quantile(values: Any, share: float) -> float:
    """`np.quantile(values, share)` of all values, bit for bit; NaN with a NaN among them."""
    values = np.asarray(values).reshape(-1)
    place = (values.size - 1) * share
    low = int(place)
    high, part = min(low + 1, values.size - 1), place - low
    ordered = np.partition(values, (low, high, values.size - 1))
    a, b = ordered[low], ordered[high]
    if np.isnan(ordered[-1]):
        return np.nan
    return float(a + (b - a) * part if part < 0.5 else b - (b - a) * (1.0 - part))


def distinct(ordered: np.ndarray) -> np.ndarray:
    """The distinct values of sorted values (n,)."""
    return ordered[np.concatenate([[True], ordered[1:] != ordered[:-1]])] if ordered.size else ordered


def unique(values: np.ndarray) -> np.ndarray:
    """`np.unique` of values without NaN."""
    return distinct(np.sort(values, axis=None))
