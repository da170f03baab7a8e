"""Damaged logs: the damage itself, and a few hundred mutations of real logs."""

from pathlib import Path

import numpy as np
import pytest

import fuzzing

CORRUPT = Path(__file__).parents[1] / "../shared/flights/corrupt"
DATA = bytes(range(256)) * 40


def test_damage_can_be_repeated_and_varies():
    assert fuzzing.mutate(DATA, 1, 7) == fuzzing.mutate(DATA, 1, 7)
    copies = {fuzzing.mutate(DATA, 1, n)[0] for n in range(200)}
    assert len(copies) > 190 and DATA not in copies
    assert {part for n in range(200) for part in fuzzing.mutate(DATA, 1, n)[1].split(" + ")} == set(fuzzing.DAMAGE)


@pytest.mark.parametrize("name", fuzzing.DAMAGE)
def test_damage_survives_tiny_logs(name):
    rng = np.random.default_rng(0)
    for size in (1, 2, 3, 30):
        for _ in range(30):
            fuzzing.DAMAGE[name](np.arange(size, dtype=np.uint8), rng)


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("name", ["intact_reference.bin", "intact_reference.ulg"])
def test_damaged_logs_are_read_or_rejected_politely(name, amount):
    if not CORRUPT.is_dir():
        pytest.skip("the flight logs for tests are not here (../shared/flights)")
    trials = amount(80, 200)
    outcomes, failures = fuzzing.anywhere(CORRUPT / name, trials, seed=5)
    assert failures == [] and sum(outcomes.values()) == trials
    assert outcomes["rejected"] > 0 and outcomes["read with warnings"] > 0
