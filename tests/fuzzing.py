"""Damaged copies of a log: is each one an answer or one clear sentence, and is the answer a right one?

    python tests/fuzzing.py LOG [--mutations 1500]              damage anywhere; 2 % of the copies are diagnosed as well
    python tests/fuzzing.py LOG --framed [--mutations 100]      damage inside valid framing; each answer against the intact log's

Every copy follows from (seed, number) alone, so a failure can be repeated by its number. Exit code 1 when any failed.
"""

from __future__ import annotations

import argparse
import gzip
import lzma
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

import framed_damage
from rotorwatch.base.incoming import TooLong, within
from rotorwatch.diagnose import diagnose
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.logs import read

LIMIT_S = 60.0  # for one copy
KINDS = tuple(framed_damage.KINDS)
WRONG = ("false fault", "wrong rotor", "FAILED")


def load(path: str | os.PathLike) -> tuple[bytes, str]:
    """(the log's bytes, its name), both unpacked: damage goes to the log, not to its container."""
    name = Path(path).name
    unpack = lzma.open if name.endswith(".xz") else gzip.open if name.endswith(".gz") else open
    with unpack(path, "rb") as file:
        return file.read(), name.removesuffix(".xz").removesuffix(".gz")


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
    return np.delete(data, _block(data, rng))


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


def _attempt(copy: bytes, name: str, assess: Callable[[Path], str]) -> tuple[str, str]:
    """(outcome, what went wrong) of one damaged copy: what `assess` says of the file, unless it raises."""
    with tempfile.TemporaryDirectory(prefix="rotorwatch-fuzz-") as folder:
        path = Path(folder) / name
        path.write_bytes(copy)
        try:
            with within(LIMIT_S):
                return assess(path), ""
        except RotorwatchError as why:
            sentence = str(why).strip()
            return ("rejected", sentence) if sentence else ("FAILED", f"{type(why).__name__} without a sentence")
        except (Exception, TooLong) as why:
            return "FAILED", f"{type(why).__name__}: {why}"[:300]


def anywhere(path: str | os.PathLike, mutations: int, seed: int = 0, diagnosed: float = 0.0) -> tuple[Counter, list]:
    """Read so many damaged copies of a log, diagnose a share of them: (how often each outcome, [(number, damage, what failed)])."""
    data, name = load(path)
    outcomes, failures = Counter(), []
    for number in range(mutations):
        assessed = np.random.default_rng([seed, number, 1]).random() < diagnosed

        def assess(file: Path, assessed: bool = assessed) -> str:
            flight = read(file)
            if assessed:
                diagnose(flight).to_json()
            return "read with warnings" if flight.warnings else "read"

        copy, damage = mutate(data, seed, number)
        outcome, what = _attempt(copy, name, assess)
        outcomes[outcome] += 1
        if outcome == "FAILED":
            failures.append((number, damage, what))
    return outcomes, failures


def framed(path: str | os.PathLike, copies: int, share: float = 0.05, seed: int = 0) -> tuple[dict[str, Counter], list]:
    """Diagnose so many copies of each kind of damage inside valid framing (`framed_damage.KINDS`), with `share` of the records damaged:
    ({kind: how often each outcome}, [(number, kind, outcome, why)] of the WRONG ones)."""
    data, name = load(path)
    records, intact = framed_damage.records(data, name), diagnose(path)
    table, failures = {kind: Counter() for kind in KINDS}, []
    for number in range(copies * len(KINDS)):
        kind = KINDS[number % len(KINDS)]
        rng = np.random.default_rng([seed, number])
        copy = framed_damage.damaged(data, records, kind, share, rng)
        outcome, what = _attempt(copy, name, lambda file: compared(intact, diagnose(file)))
        table[kind][outcome] += 1
        if outcome in WRONG:
            failures.append((number, kind, outcome, what))
    return table, failures


def compared(intact: Diagnosis, damaged: Diagnosis) -> str:
    """What the answer to a damaged copy is worth: same (verdict and rotors), less (inconclusive, ambiguous, missed), or WRONG."""
    named = {r for e in intact.events for group in (e.rotors, *e.alternatives) for r in group}
    sure = {r for e in damaged.events if not e.alternatives for r in e.rotors}
    if damaged.verdict == "fault" and not sure <= named:
        return "wrong rotor" if named else "false fault"
    if damaged.verdict in ("fault", intact.verdict):
        return "same" if intact.verdict in ("fault", damaged.verdict) else "false fault"
    return damaged.verdict if damaged.verdict in ("inconclusive", "ambiguous") else "missed"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log")
    parser.add_argument("--mutations", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--framed", action="store_true")
    given = parser.parse_args()
    began = time.perf_counter()
    if given.framed:
        table, failures = framed(given.log, -(-given.mutations // len(KINDS)), seed=given.seed)
        for kind, outcomes in table.items():
            print(f"{kind}: {dict(outcomes)}")
    else:
        outcomes, failures = anywhere(given.log, given.mutations, given.seed, 0.02)
        print(dict(outcomes))
    for failure in failures:
        print(*failure)
    print(f"{time.perf_counter() - began:.0f} s")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
