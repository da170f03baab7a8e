"""How robust is the answer for this kind of log? Damage inside valid framing, each copy diagnosed and compared.

Every damaged copy follows from (seed, number) alone: number n has the n-th of `damage.KINDS` in turn.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.experiments import damage
from rotorwatch.experiments.fuzz import Mutations, here, load, pool
from rotorwatch.flight.diagnosis import Diagnosis

OUTCOMES = ("same", "inconclusive", "ambiguous", "missed", "rejected", "false fault", "wrong rotor", "FAILED")
"""Same verdict and rotors; three ways to say less; a sentence instead of an answer; three that must not be."""
WRONG = OUTCOMES[-3:]
KINDS = tuple(damage.KINDS)


def fuzz_framed(
    path: str | os.PathLike,
    damages: int = 20,
    share: float = 0.05,
    seed: int = 0,
    jobs: int | None = None,
    timeout_s: float = 60.0,
    memory_mb: int = 2000,
    progress: Callable[[float, str], None] | None = None,
) -> dict:
    """Diagnose `damages` damaged copies of the log at `path` for each kind of damage; compare with the intact log's answer.

    path: a log file whose framing is known. damages: copies of each kind. seed: of the random damage. progress: called with the finished
    share. share: of the records that are damaged in each copy. jobs, timeout_s, memory_mb: as in `fuzz.fuzz`. Returns log, seed,
    share, damages, verdict and rotors of the intact log, table ({kind: {outcome: count}}, see OUTCOMES), slowest_s, and
    failures ([{number, kind, outcome, what}]) with all that must not be. Raises ConfigError for formats without framing
    that is known, LogError when the intact log cannot be judged.
    """
    if not 0.0 < share <= 1.0:
        raise ConfigError(f"--share {share:g}: a share of the records is above 0 and at most 1.")
    data, name = load(path), Path(path).name.removesuffix(".xz").removesuffix(".gz")
    damage.records(data, name)  # raises for other formats, before any worker starts
    verdict, sure, named = _answer(_judged(Path(path)))
    task = Task(data, name, seed, 1.0, timeout_s, share, verdict, named)
    total = damages * len(KINDS)
    results = here(task, total) if jobs == 0 else pool(task, total, jobs, memory_mb)
    table: dict[str, dict[str, int]] = {kind: dict.fromkeys(OUTCOMES, 0) for kind in KINDS}
    failures, slowest = [], 0.0
    for done, (number, outcome, what, _) in enumerate(results, 1):
        details: dict[str, Any] = what if isinstance(what, dict) else {"what": what, "seconds": timeout_s}
        table[KINDS[number % len(KINDS)]][outcome] += 1
        slowest = max(slowest, details["seconds"])
        if outcome in WRONG:
            failures.append(
                {"number": number, "kind": KINDS[number % len(KINDS)], "outcome": outcome, "what": details["what"]}
            )
        if progress:
            progress(done / total, f"{len(failures)} wrong")
    return {
        "log": str(path),
        "seed": seed,
        "share": share,
        "damages": damages,
        "verdict": verdict,
        "rotors": sorted(sure),
        "table": table,
        "slowest_s": round(slowest, 2),
        "failures": sorted(failures, key=lambda f: f["number"]),
    }


@dataclass(frozen=True)
class Task(Mutations):
    """As `fuzz.Mutations`, with the share of records to damage, the intact log's verdict, and all rotors that it names."""

    share: float
    verdict: str
    named: frozenset[int]

    @cached_property
    def found(self) -> damage.Records:
        return damage.records(self.data, self.name)

    def copy(self, number: int) -> bytes:
        """The damaged copy with this number."""
        rng = np.random.default_rng([self.seed, number])
        return damage.damaged(self.data, self.found, KINDS[number % len(KINDS)], self.share, rng)

    def attempt(self, number: int, folder: str) -> tuple[str, Any]:
        """(outcome, {what: the reason given, seconds: of reading and diagnosing}) of one damaged copy."""
        path = Path(folder) / self.name
        path.write_bytes(self.copy(number))
        began = time.perf_counter()
        try:
            diagnosis = _judged(path)
            outcome, what = self.compare(diagnosis), diagnosis.reason
        except RotorwatchError as why:
            outcome, what = "rejected", str(why)
        except Exception as why:
            outcome, what = "FAILED", f"{type(why).__name__}: {why}"[:300]
        finally:
            path.unlink(missing_ok=True)
        return outcome, {"what": what, "seconds": time.perf_counter() - began}

    def compare(self, diagnosis: Diagnosis) -> str:
        """The outcome that an answer to a damaged copy is."""
        verdict, sure, _ = _answer(diagnosis)
        if verdict == "fault" and not sure <= self.named:
            return "wrong rotor" if self.named else "false fault"
        if verdict in ("fault", self.verdict):
            return "same" if self.verdict in ("fault", verdict) else "false fault"
        return verdict if verdict in OUTCOMES else "missed"


def _judged(path: Path) -> Diagnosis:
    from rotorwatch.diagnose import diagnose

    return diagnose(path)


def _answer(diagnosis: Diagnosis) -> tuple[str, frozenset[int], frozenset[int]]:
    """(verdict, rotors that events accuse without an alternative, all rotors that events and alternatives name)."""
    sure = {r for e in diagnosis.events if not e.alternatives for r in e.rotors}
    named = {r for e in diagnosis.events for group in (e.rotors, *e.alternatives) for r in group}
    return diagnosis.verdict, frozenset(sure), frozenset(named)
