"""Limits of time and memory for work on files that nobody has looked at yet, set by the process that does it (many/processes.py)."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

GRACE_S = 30.0  # beyond a job's own time limit: then its process does not come back and is killed


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
