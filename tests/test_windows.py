"""Sums over windows of a table, piece by piece."""

import functools

import numpy as np

from rotorwatch.base import windows


def test_sums_over_windows_are_those_of_their_rows(monkeypatch):
    """Whatever is worked on at a time: windows that overlap, leave gaps, are empty, and are longer than that."""
    rng = np.random.default_rng(1)
    values = rng.normal(size=(500, 2))
    low = np.sort(rng.integers(0, 501, 80))
    high = np.minimum(np.maximum.accumulate(low + rng.integers(0, 60, 80)), 500)
    expected = [values[a:b].sum(axis=0) for a, b in zip(low, high)]
    for rows in (1, 7, 40, 10_000):
        groups = list(windows.groups(low, high, rows))
        assert np.concatenate([np.arange(80)[some] for some in groups]).tolist() == list(range(80))
        assert all(high[some][-1] - low[some][0] <= max(rows, high[some][0] - low[some][0]) for some in groups)
        monkeypatch.setattr(windows, "groups", functools.partial(windows.groups, most=rows))
        np.testing.assert_allclose(windows.sums(values, low, high), expected, atol=1e-12)
        monkeypatch.undo()
