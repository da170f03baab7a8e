"""A job on untrusted files, in processes of this computer with limits of time and memory. A process that dies or hangs is replaced."""

from __future__ import annotations

import functools
import pickle
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rotorwatch.base import incoming
from rotorwatch.base.many.processes import Worker
from rotorwatch.errors import WorkerError


class TooMuch(WorkerError):
    """A file needed too much time or memory; the sentence says which limit it was."""


@dataclass(frozen=True)
class _Limited:
    """A job with a time limit that its process keeps itself."""

    job: Callable[[Any], Any]
    timeout_s: float

    def __call__(self, what: Any) -> Any:
        try:
            with incoming.within(self.timeout_s):
                return self.job(what)
        except incoming.TooLong as why:
            raise WorkerError(str(why), "took too long") from None


class Workers:
    """Processes that run one job, as many as threads call at once; each is reused.

    job: importable, called with one item. assess_s [s], memory_mb [MB beyond the process after loading]: for one item. loads: modules that
    a process loads first; prepare: called after that."""

    def __init__(
        self,
        job: Callable[[Any], Any],
        assess_s: float,
        memory_mb: int,
        loads: Sequence[str] = (),
        prepare: Callable[[], None] | None = None,
    ):
        self._assess_s, self._memory_mb, self._stopping = assess_s, memory_mb, False
        self._work = pickle.dumps((_Limited(job, assess_s), functools.partial(_prepare, memory_mb, tuple(loads), prepare)))
        self._lock = threading.Lock()
        self._idle: list[Worker] = []
        self._all: list[Worker] = []

    def start(self) -> None:
        """Start a process before the first item comes."""
        self._idle.append(self._worker())

    def stop(self) -> None:
        """End all processes, also busy ones."""
        self._stopping = True
        with self._lock:
            for worker in self._all:
                worker.kill()
            for worker in self._idle:  # nobody waits for it
                worker.stop()

    def call(self, item: Any) -> Any:
        """job(item). Raises what the job raises, TooMuch, and WorkerError where no process can be started.

        After a process that died it is tried a second time: something else may have ended the first."""
        for last in (False, True):
            with self._lock:
                worker = self._idle.pop() if self._idle else self._worker()
            try:
                return worker.call(item)
            except (WorkerError, MemoryError) as why:
                if self._stopping or not worker.ready:
                    raise
                died = isinstance(why, WorkerError) and why.how.startswith("died")
                if last or not died:
                    raise TooMuch(self._sentence(why)) from None
            finally:
                with self._lock:
                    if worker.alive:
                        self._idle.append(worker)
                    else:
                        self._all.remove(worker)
        raise AssertionError

    def _sentence(self, why: Exception) -> str:
        if isinstance(why, WorkerError) and not why.how.startswith("died"):
            return f"the diagnosis exceeded {self._assess_s:g} s and was aborted; try `rotorwatch diagnose`."
        return f"the diagnosis exceeded {self._memory_mb} MB of memory and was aborted; try `rotorwatch diagnose`."

    def _worker(self) -> Worker:
        worker = Worker(self._work, self._assess_s + incoming.GRACE_S)
        self._all.append(worker)
        return worker


def _prepare(memory_mb: int, loads: Sequence[str], more: Callable[[], None] | None) -> None:
    incoming.cap_memory(memory_mb, loads)
    if more is not None:
        more()
