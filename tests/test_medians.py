"""Medians in definitions: of the first numbers, in any order."""

import numpy as np

from rotorwatch.base import medians


def test_a_median_is_of_the_first_numbers():
    rng = np.random.default_rng(1)
    for count in range(1, 17):
        values = rng.choice([0.0, 1.0, *rng.standard_normal(9)], 16)
        assert medians.median(values.tolist(), count) == np.median(values[:count])


def test_every_rank_is_found_and_the_others_stay():
    rng = np.random.default_rng(2)
    values = rng.choice([0.0, 1.0, *rng.standard_normal(9)], 16).tolist()
    for k in range(12):
        some = list(values)
        assert medians.ranked(some, 12, k) == sorted(values[:12])[k] and some[12:] == values[12:]
