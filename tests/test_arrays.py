"""What stands for a function of NumPy gives what that gives."""

import numpy as np
import pytest

from rotorwatch.base.arrays import distinct, median, quantile, unique


@pytest.mark.parametrize("kind", [float, int, np.uint16, np.float32])
def test_a_median_is_numpys_bit_for_bit(kind):
    rng = np.random.default_rng(4)
    for shape in ((1,), (2,), (7,), (50,), (3, 4), (4, 3), (2, 1, 5)):
        values = (60_000.0 * rng.random(shape)).astype(kind)
        for axis in (None, *range(-len(shape), len(shape))):
            found, wanted = median(values, axis), np.median(values, axis)
            assert np.array_equal(found, wanted) and found.dtype == wanted.dtype
    holes = np.array([[1.0, np.nan, 2.0], [3.0, 4.0, 5.0]])
    assert np.array_equal(median(holes, axis=1), np.median(holes, axis=1), equal_nan=True) and np.isnan(median(holes))


@pytest.mark.parametrize("kind", [float, int, np.float32])
def test_a_quantile_is_numpys_bit_for_bit(kind):
    rng = np.random.default_rng(5)
    for size in (1, 2, 3, 4, 7, 50, 101):
        values = (100.0 * rng.standard_normal((size, 2))).astype(kind)
        for share in (0.0, 0.05, 0.5, 0.8, 0.9, 0.99, 1.0, *rng.random(20)):
            assert quantile(values, share) == np.quantile(values, share)
    assert np.isnan(quantile([1.0, np.nan, 2.0], 0.1))


def test_distinct_values_are_numpys():
    for values in ([], [1.0], [1.0, 1.0, 2.0, 3.0, 3.0]):
        assert distinct(np.array(values)).tolist() == np.unique(values).tolist()
    for values in ([], [3, 1, 3, 2], [[2, 1], [1, 2]]):
        assert unique(np.array(values, np.uint8)).tolist() == np.unique(values).tolist()
