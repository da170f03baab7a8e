"""Damage a log at random and see whether reading and diagnosing it stays civil: an answer or one clear sentence.

Every mutation follows from (seed, number) alone, so a failure can be repeated by its number.
"""

from __future__ import annotations

import functools
import gzip
import lzma
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch import many
from rotorwatch.base import incoming as limited
from rotorwatch.errors import ConfigError, RotorwatchError, WorkerError

OUTCOMES = ("read", "read with warnings", "rejected with a sentence", "FAILED")
MOST_FAILURES = 20


def fuzz(
    path: str | os.PathLike,
    mutations: int = 10_000,
    seed: int = 0,
    jobs: int | None = None,
    diagnosed: float = 0.02,
    timeout_s: float = 30.0,
    memory_mb: int = 2000,
    progress: Callable[[float, str], None] | None = None,
) -> dict:
    """Read `mutations` damaged copies of the log at `path`, diagnose the share `diagnosed` of them.

    path: a log file of any known format. mutations: how many copies. seed: of the random damage. diagnosed: share, 0 to 1, that is
    not only read but judged. progress: called with the finished share.
    jobs: worker processes (default: one per processor); 0 does everything in this process, without limits.
    timeout_s: seconds that one mutation may take; memory_mb: MB that one may take beyond what a worker starts with. Returns log, seed,
    mutations, diagnosed (count), outcomes ({outcome: count}, see OUTCOMES) and failures ([{number, mutation, what}], first 20). An
    outcome is FAILED for any exception other than a RotorwatchError, for a crash, and beyond a limit.
    """
    task = Mutations(load(path), Path(path).name.removesuffix(".xz").removesuffix(".gz"), seed, diagnosed, timeout_s)
    results = here(task, mutations) if jobs == 0 else pool(task, mutations, jobs, memory_mb)
    outcomes: dict[str, int] = dict.fromkeys(OUTCOMES, 0)
    failures, judged = [], 0
    for done, (number, outcome, what, was_judged) in enumerate(results, 1):
        outcomes[outcome] += 1
        judged += was_judged
        if outcome == "FAILED" and len(failures) < MOST_FAILURES:
            failures.append({"number": number, "mutation": mutate(task.data, seed, number)[1], "what": what})
        if progress:
            progress(done / mutations, f"{outcomes['FAILED']} failed")
    failures.sort(key=lambda f: f["number"])
    return {
        "log": str(path),
        "seed": seed,
        "mutations": mutations,
        "diagnosed": judged,
        "outcomes": outcomes,
        "failures": failures,
    }


def load(path: str | os.PathLike) -> bytes:
    """The log's bytes, unpacked: damage goes to the log, not to its container."""
    name = str(path)
    unpack = lzma.open if name.endswith(".xz") else gzip.open if name.endswith(".gz") else open
    try:
        with unpack(path, "rb") as file:
            data = file.read()
    except (OSError, EOFError, lzma.LZMAError) as why:
        raise ConfigError(f"Cannot read {path}: {why}; fuzz needs one intact log file.") from None
    if not data:
        raise ConfigError(f"{path} is empty; fuzz needs one intact log file.")
    return data


def mutate(data: bytes, seed: int, number: int) -> tuple[bytes, str]:
    """The damaged copy with this number, and what was done to it. One to three kinds of damage at random places."""
    rng = np.random.default_rng([seed, number])
    out = np.frombuffer(data, np.uint8).copy()
    done = []
    for _ in range(int(rng.integers(1, 4))):
        if not out.size:
            break
        name = str(rng.choice(list(DAMAGE)))
        out = DAMAGE[name](out, rng)
        done.append(name)
    return out.tobytes(), " + ".join(done)


def _block(data: np.ndarray, rng: np.random.Generator) -> slice:
    """A random block; lengths are log-uniform, from one byte to a tenth of the log."""
    length = int(np.exp(rng.uniform(0.0, np.log(max(data.size / 10, 2.0)))))
    start = int(rng.integers(0, max(data.size - length, 0) + 1))
    return slice(start, start + length)


def _flip(data, rng, first=None):
    span = data.size if first is None else min(first, data.size)
    at = rng.integers(0, span, int(rng.integers(1, 65)))
    data[at] ^= (1 << rng.integers(0, 8, at.size)).astype(np.uint8)
    return data


def _truncate(data, rng):
    return data[: int(rng.integers(0, data.size))]


def _remove(data, rng):
    block = _block(data, rng)
    return np.delete(data, block)


def _duplicate(data, rng):
    block = _block(data, rng)
    at = int(rng.integers(0, data.size + 1))
    return np.concatenate([data[:at], data[block], data[at:]])


def _fill(data, rng, value=None):
    block = _block(data, rng)
    data[block] = rng.integers(0, 256, data[block].size) if value is None else value
    return data


DAMAGE: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "bits flipped": _flip,
    "bits flipped in the head": lambda data, rng: _flip(data, rng, 4096),
    "truncated": _truncate,
    "block removed": _remove,
    "block duplicated": _duplicate,
    "block zeroed": lambda data, rng: _fill(data, rng, 0),
    "block of 0xff": lambda data, rng: _fill(data, rng, 255),
    "block of noise": _fill,
}


@dataclass(frozen=True)
class Mutations:
    """What a worker needs to know: the intact log, its name (for the suffix), seed, share to diagnose, time limit."""

    data: bytes
    name: str
    seed: int
    diagnosed: float
    timeout_s: float

    def judged(self, number: int) -> bool:
        """Whether this mutation is diagnosed, not only read."""
        return np.random.default_rng([self.seed, number, 1]).random() < self.diagnosed

    def attempt(self, number: int, folder: str) -> tuple[str, Any]:
        """(outcome, what went wrong, a text) of one mutation."""
        from rotorwatch.logs import read

        damaged, _ = mutate(self.data, self.seed, number)
        path = Path(folder) / self.name
        path.write_bytes(damaged)
        try:
            flight = read(path)
            if self.judged(number):
                from rotorwatch.diagnose import diagnose

                diagnose(flight).to_json()
        except RotorwatchError as why:
            sentence = str(why).strip()
            return (
                ("rejected with a sentence", "") if sentence else ("FAILED", f"{type(why).__name__} without a sentence")
            )
        except Exception as why:
            return "FAILED", f"{type(why).__name__}: {why}"[:300]
        finally:
            path.unlink(missing_ok=True)
        return ("read with warnings" if flight.warnings else "read"), ""


def here(task: Mutations, mutations: int):
    """Results from this process."""
    with tempfile.TemporaryDirectory(prefix="rotorwatch-fuzz-") as folder:
        for number in range(mutations):
            yield number, *task.attempt(number, folder), task.judged(number)


@dataclass(frozen=True)
class _Limited:
    """One mutation after the other, in a worker: copies go to a folder of its own below `root`."""

    task: Mutations
    root: str

    @cached_property
    def folder(self) -> str:
        return tempfile.mkdtemp(dir=self.root)

    def __call__(self, number: int) -> tuple[str, Any]:
        try:
            with limited.within(self.task.timeout_s):
                return self.task.attempt(number, self.folder)
        except limited.TooLong as why:
            return "FAILED", str(why)


def pool(task: Mutations, mutations: int, jobs: int | None, memory_mb: int):
    """Results from worker processes, in the order they come. A worker that dies or hangs is replaced."""
    limit_s = task.timeout_s + limited.GRACE_S
    with tempfile.TemporaryDirectory(prefix="rotorwatch-fuzz-") as root:
        prepare = functools.partial(limited.cap_memory, memory_mb, ("rotorwatch.logs", "rotorwatch.diagnose"))
        work = many.run(_Limited(task, root), range(mutations), jobs, limit_s=limit_s, tries=1, prepare=prepare)
        for done in work:
            if isinstance(done.error, WorkerError):
                hung = done.error.how.startswith("hung")
                what = f"hung for {task.timeout_s:g} s and more" if hung else f"the process {done.error.how}"
                result = "FAILED", what
            else:
                result = done.result()
            yield done.index, *result, task.judged(done.index)
