"""Foreign logs: streams (a pipe, an address) written to a file, within limits of size and time; a temporary folder of the process; and
limits of time and memory for work on unchecked files, set by the process that does it."""

from __future__ import annotations

import atexit
import importlib
import os
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rotorwatch.errors import LogError

MOST = 4 << 30
"""Bytes of a log, wherever it comes from and however it is packed."""
STALLS_S, MOST_S = 60.0, 1800.0
"""For the next block of a stream, and for all of it."""
GRACE_S = 30.0  # beyond a job's own time limit, before its process is killed
_BLOCK = 1 << 20
_spool: dict[int, Path] = {}


def spool() -> Path:
    """The temporary folder of this process. Its child processes create theirs inside it."""
    import tempfile

    if os.getpid() not in _spool:  # after a fork the parent's is not ours to remove
        _spool.clear()
        _spool[os.getpid()] = Path(tempfile.mkdtemp(prefix="rotorwatch-"))
        atexit.register(_remove, os.getpid(), _spool[os.getpid()])
    return _spool[os.getpid()]


def spooled() -> Path | None:
    """The temporary folder, if there is one already."""
    return _spool.get(os.getpid())


def tidy() -> None:
    """Remove the temporary folder now: before an exit of the process that runs no handlers."""
    for process, folder in list(_spool.items()):
        _remove(process, folder)


def _remove(process: int, folder: Path) -> None:
    if process == os.getpid():
        import shutil

        shutil.rmtree(folder, ignore_errors=True)


def keep(stream: Any, path: Path, name: str, waits: bool = False) -> None:
    """Write all of a binary stream into a file. waits: without a time limit, as for the output of another program.

    Raises LogError when it is larger than a log can be or does not arrive; errors of reading and writing pass."""
    size = 0
    with path.open("wb") as file:
        for block in iter(lambda: stream.read(_BLOCK), b"") if waits else _in_time(stream, name):
            size += len(block)
            if size > MOST:
                raise LogError(f"{name} holds more than {MOST >> 30} GB, which no flight log does.")
            file.write(block)


def _in_time(stream: Any, name: str) -> Iterator[bytes]:
    """The blocks of a stream, read by a thread: a read cannot be cancelled, but waiting for a thread can."""
    import queue
    import threading

    blocks: queue.Queue = queue.Queue(maxsize=4)
    wanted = threading.Event()
    wanted.set()

    def read() -> None:
        block: Any = None
        while wanted.is_set() and block != b"" and not isinstance(block, Exception):
            try:
                block = stream.read(_BLOCK)
            except Exception as why:
                block = why
            blocks.put(block)

    threading.Thread(target=read, daemon=True).start()
    end = time.monotonic() + MOST_S
    try:
        while True:
            try:
                block = blocks.get(timeout=max(0.0, min(STALLS_S, end - time.monotonic())))
            except queue.Empty:
                late = f"nothing came for {STALLS_S:g} s"
                if time.monotonic() >= end:
                    late = f"not whole after {MOST_S / 60.0:g} minutes"
                raise LogError(f"{name}: {late}; download it by other means, then give the file.") from None
            if isinstance(block, Exception):
                raise block
            if not block:
                return
            yield block
    finally:
        wanted.clear()
        while not blocks.empty():  # the thread may be waiting for space
            blocks.get_nowait()


class TooLong(BaseException):
    """Raised by the process' own timer; no except clause of a reader catches it. The text says how long."""


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
    """Limit the address space of this process to its current size plus memory_mb, where the system can. loads: modules that do not
    count."""
    for name in loads:  # before measuring
        with suppress(ImportError):
            importlib.import_module(name)
    with suppress(ImportError, OSError, ValueError):
        import resource

        have = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        most = have + memory_mb * 2**20
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
