"""Damaged logs: the damage itself, the guard around workers, and a few hundred mutations of real logs."""

import gzip
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rotorwatch.base import incoming as limited
from rotorwatch.errors import ConfigError
from rotorwatch.experiments import fuzz

CORRUPT = Path(__file__).parents[1] / "../shared/flights/corrupt"
DATA = bytes(range(256)) * 40


def test_damage_can_be_repeated_and_varies():
    assert fuzz.mutate(DATA, 1, 7) == fuzz.mutate(DATA, 1, 7)
    copies = {fuzz.mutate(DATA, 1, n)[0] for n in range(200)}
    assert len(copies) > 190 and DATA not in copies
    assert {part for n in range(200) for part in fuzz.mutate(DATA, 1, n)[1].split(" + ")} == set(fuzz.DAMAGE)


@pytest.mark.parametrize("name", fuzz.DAMAGE)
def test_damage_survives_tiny_logs(name):
    rng = np.random.default_rng(0)
    for size in (1, 2, 3, 30):
        for _ in range(30):
            fuzz.DAMAGE[name](np.arange(size, dtype=np.uint8), rng)


def test_packed_logs_are_unpacked_before_damage(tmp_path):
    (tmp_path / "a.bin.gz").write_bytes(gzip.compress(DATA))
    assert fuzz.load(tmp_path / "a.bin.gz") == DATA
    for broken in ("a.bin.xz", "missing.bin", "."):
        if broken.endswith(".xz"):
            (tmp_path / broken).write_bytes(b"not xz")
        with pytest.raises(ConfigError, match="intact log"):
            fuzz.load(tmp_path / broken)


@dataclass(frozen=True)
class Evil(fuzz.Mutations):
    """A task that misbehaves in every way a reader could."""

    def judged(self, number):
        return False

    def attempt(self, number, folder):
        if number == 1:
            os._exit(7)
        if number == 2:
            while True:
                pass
        if number == 3:
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})  # as in compiled code that never returns
            time.sleep(60)
        if number == 4:
            try:
                bytearray(3_000_000_000)
            except MemoryError:
                return "FAILED", "MemoryError"
        return "read", ""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory and time are Linux's")
def test_workers_that_die_hang_or_eat_memory_are_found_and_replaced(monkeypatch):
    monkeypatch.setattr(limited, "GRACE_S", 1.0)
    results = list(fuzz.pool(Evil(DATA, "a.bin", 0, 0.0, 0.3), 8, 2, 500))
    assert sorted(number for number, *_ in results) == list(range(8))
    failed = {number: what for number, outcome, what, _ in results if outcome == "FAILED"}
    assert sorted(failed) == [1, 2, 3, 4]
    assert failed[1] == "the process died (exit code 7)" and failed[2] == "took longer than 0.3 s"
    assert failed[3].startswith("hung") and failed[4] == "MemoryError"


@pytest.mark.thorough(keep=1)
@pytest.mark.parametrize("name", ["intact_reference.bin", "intact_reference.ulg"])
def test_damaged_logs_are_read_or_rejected_politely(name, amount):
    if not CORRUPT.is_dir():
        pytest.skip("the flight logs for tests are not here (../shared/flights)")
    trials = amount(80, 200)
    result = fuzz.fuzz(CORRUPT / name, mutations=trials, seed=5, jobs=0, diagnosed=0.0)
    assert result["failures"] == []
    assert sum(result["outcomes"].values()) == trials and result["outcomes"]["rejected with a sentence"] > 0
    assert result["outcomes"]["read with warnings"] > 0
