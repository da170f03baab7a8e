"""Damage a log at random and see whether reading and diagnosing it stays civil: an answer or one clear sentence.

Every mutation follows from (seed, number) alone, so a failure can be repeated by its number.
"""

from __future__ import annotations

import contextlib
import gzip
import lzma
import os
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import connection, get_context
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.errors import ConfigError, RotorwatchError

OUTCOMES = ("read", "read with warnings", "rejected with a sentence", "FAILED")
KEPT_FAILURES = 20
START_S = 120.0  # for a worker to load what it needs
GRACE_S = 30.0  # beyond a mutation's own time limit: then the worker does not come back and is killed


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
    if jobs == 0:
        results = here(task, mutations)
    else:
        results = pool(task, mutations, jobs or os.cpu_count() or 1, memory_mb)
    outcomes: dict[str, int] = dict.fromkeys(OUTCOMES, 0)
    failures, judged = [], 0
    for done, (number, outcome, what, was_judged) in enumerate(results, 1):
        outcomes[outcome] += 1
        judged += was_judged
        if outcome == "FAILED" and len(failures) < KEPT_FAILURES:
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


class _TooLong(BaseException):
    """Raised by the worker's own clock; no except clause of a reader swallows it."""


def _work(pipe, task: Mutations, folder: str, memory_mb: int) -> None:
    """A worker: says that it is ready, then numbers in, outcomes out, until the pipe closes. Copies go to `folder`."""
    _limit_memory(memory_mb)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop

    def too_long(*_):
        raise _TooLong

    if hasattr(signal, "SIGALRM"):
        signal.signal(signal.SIGALRM, too_long)
    with contextlib.suppress(EOFError, OSError):
        pipe.send("ready")
        while True:
            number = pipe.recv()
            try:
                if hasattr(signal, "setitimer"):
                    signal.setitimer(signal.ITIMER_REAL, task.timeout_s)
                result = task.attempt(number, folder)
            except _TooLong:
                result = "FAILED", f"took longer than {task.timeout_s:g} s"
            finally:
                if hasattr(signal, "setitimer"):
                    signal.setitimer(signal.ITIMER_REAL, 0.0)
            pipe.send((number, *result, task.judged(number)))


def _limit_memory(memory_mb: int) -> None:
    """Cap the address space at what the process has plus memory_mb, where the system can."""
    from importlib import import_module

    for name in ("rotorwatch.logs", "rotorwatch.diagnose"):  # before measuring, so that libraries do not count
        with contextlib.suppress(ImportError):
            import_module(name)
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        have = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        most = have + memory_mb * 2**20
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


class _Worker:
    """One worker process, its pipe, and the mutation it is busy with."""

    def __init__(self, context: Any, task: Mutations, root: str, memory_mb: int):
        self.pipe, theirs = context.Pipe()
        args = (theirs, task, tempfile.mkdtemp(dir=root), memory_mb)
        self.process = context.Process(target=_work, args=args, daemon=True)
        self.process.start()
        theirs.close()
        self.number, self.deadline, self.ready = -1, np.inf, False

    def give(self, number: int, limit_s: float) -> None:
        """Hand over a mutation; its time begins when the worker has started."""
        if not self.ready:
            try:
                self.ready = self.pipe.poll(START_S) and bool(self.pipe.recv())
            except (EOFError, OSError):
                pass
            if not self.ready:
                raise ConfigError("A worker process does not start; is there enough memory? Try --jobs 1.")
        self.number, self.deadline = number, time.monotonic() + limit_s
        self.pipe.send(number)

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def pool(task: Mutations, mutations: int, jobs: int, memory_mb: int):
    """Results from worker processes, in the order they come. A worker that dies or hangs is replaced."""
    context = get_context("spawn")  # a fork would inherit locks of numerical libraries
    grace = task.timeout_s + GRACE_S
    todo = iter(range(mutations))
    busy: list[_Worker] = []
    with tempfile.TemporaryDirectory(prefix="rotorwatch-fuzz-") as root:
        try:
            busy += [_Worker(context, task, root, memory_mb) for _ in range(min(jobs, mutations))]
            for worker, number in zip(busy, todo):
                worker.give(number, grace)
            while busy:
                wait = max(0.0, min(w.deadline for w in busy) - time.monotonic())
                ready = connection.wait([w.pipe for w in busy], wait)
                for worker in [w for w in busy if w.pipe in ready or time.monotonic() > w.deadline]:
                    result = _collect(worker, task, worker.pipe in ready)
                    number = next(todo, None)
                    if number is None or not worker.process.is_alive():
                        worker.stop()
                        busy.remove(worker)
                    if number is not None:
                        if worker not in busy:
                            worker = _Worker(context, task, root, memory_mb)
                            busy.append(worker)
                        worker.give(number, grace)
                    yield result
        finally:
            for worker in busy:
                worker.stop()


def _collect(worker: _Worker, task: Mutations, ready: bool) -> tuple[int, str, str, bool]:
    """The worker's result, or what became of it."""
    if ready:
        try:
            return worker.pipe.recv()
        except (EOFError, OSError):
            worker.process.join()
            what = f"the process died (exit code {worker.process.exitcode})"
    else:
        what = f"hung for {task.timeout_s:g} s and more"
        worker.process.kill()
        worker.process.join()
    return worker.number, "FAILED", what, task.judged(worker.number)
