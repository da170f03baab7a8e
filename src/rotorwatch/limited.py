"""Work on files that nobody has looked at yet: in a process of its own, within limits of memory and time, replaced when it dies."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rotorwatch.errors import ConfigError, RotorwatchError

START_S = 120.0  # for a worker to load what it needs
GRACE_S = 30.0  # beyond a job's own time limit: then the worker does not come back and is killed
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NPROC")
"""Variables that say how many threads numerical libraries use; the last one is XLA's."""


class Failed(RotorwatchError):
    """A job has come to no answer; the text says why in a few words: beyond its time, the process died, or an error in it."""


class TooLong(BaseException):
    """Raised by the process' own clock; no except clause of a reader swallows it. The text says how long."""


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raises TooLong inside when it takes longer, where the system can: in the main thread of a process, on POSIX."""

    def too_long(*_):
        raise TooLong(f"took longer than {seconds:g} s")

    if not hasattr(signal, "setitimer"):
        yield
        return
    signal.signal(signal.SIGALRM, too_long)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


@contextmanager
def one_thread() -> Iterator[None]:
    """What is started meanwhile computes in one thread, unless the user's environment says otherwise."""
    ours = [name for name in ONE_THREAD if name not in os.environ]
    os.environ.update(dict.fromkeys(ours, "1"))
    try:
        yield
    finally:
        for name in ours:
            os.environ.pop(name, None)


def cap_memory(memory_mb: int, loads: Sequence[str] = ()) -> None:
    """Cap the address space of this process at what it has plus memory_mb, where the system can. loads: modules that do not count."""
    from importlib import import_module

    for name in loads:  # before measuring
        with contextlib.suppress(ImportError):
            import_module(name)
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        have = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        most = have + memory_mb * 2**20
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def _work(pipe, job: Callable[[Any], Any], timeout_s: float, memory_mb: int, loads: Sequence[str]) -> None:
    """A worker: says that it is ready, then what to do in, (answer, why there is none) out, until the pipe closes."""
    cap_memory(memory_mb, loads)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides when to stop
    with contextlib.suppress(EOFError, OSError):
        pipe.send("ready")
        while True:
            what = pipe.recv()
            try:
                with within(timeout_s):
                    answer = job(what), ""
            except TooLong as why:
                answer = None, str(why)
            except Exception as why:  # of one job; the worker goes on
                answer = None, f"{type(why).__name__}: {why}"[:300]
            pipe.send(answer)


class Worker:
    """One process that does one thing after another. busy: what it was given last; pipe: readable when there is an answer."""

    def __init__(self, job: Callable[[Any], Any], timeout_s: float, memory_mb: int, loads: Sequence[str] = ()):
        """job: a function of what is given; it and its arguments are sent to the process by pickle. timeout_s: for each; memory_mb: beyond
        what the process has when the modules `loads` are loaded."""
        context = get_context("spawn")  # a fork would inherit locks of numerical libraries
        self.pipe, theirs = context.Pipe()
        self._timeout_s = timeout_s
        self.process = context.Process(target=_work, args=(theirs, job, timeout_s, memory_mb, loads), daemon=True)
        with one_thread():
            self.process.start()
        theirs.close()
        self.busy: Any = None
        self.deadline, self._ready = float("inf"), False

    def give(self, what: Any) -> None:
        """Begin with it; its time begins when the worker has started. Raises ConfigError when it does not start."""
        if not self._ready:
            with contextlib.suppress(EOFError, OSError):
                self._ready = self.pipe.poll(START_S) and bool(self.pipe.recv())
            if not self._ready:
                raise ConfigError(
                    "A worker process does not start; is there enough memory? Try fewer at once (--jobs)."
                )
        self.busy, self.deadline = what, time.monotonic() + self._timeout_s + GRACE_S
        self.pipe.send(what)

    def take(self) -> Any:
        """The answer, waiting until the deadline. Raises Failed; a worker that has died or hung is dead then (`alive`)."""
        if self.pipe.poll(max(0.0, self.deadline - time.monotonic())):
            try:
                answer, why = self.pipe.recv()
            except (EOFError, OSError):
                self.process.join()
                raise Failed(f"the process died (exit code {self.process.exitcode})") from None
            if why:
                raise Failed(why)
            return answer
        self.process.kill()
        self.process.join()
        raise Failed(f"hung for {self._timeout_s:g} s and more")

    @property
    def alive(self) -> bool:
        return self.process.is_alive()

    def stop(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()
