"""Logs that come as a stream (a pipe, an address), kept in a file: limits of size and of time, and a folder that goes with the process."""

from __future__ import annotations

import atexit
import os
import queue
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rotorwatch.errors import LogError

MOST = 4 << 30
"""Bytes of a log, wherever it comes from and however it is packed."""
STALLS_S, MOST_S = 60.0, 1800.0
"""For the next block of a stream, and for all of it."""
_BLOCK = 1 << 20
_spool: dict[int, Path] = {}


def spool() -> Path:
    """The folder of this process for what is only needed while it runs. Processes that it starts keep theirs in it."""
    import tempfile

    if os.getpid() not in _spool:  # after a fork the parent's is not ours to remove
        _spool.clear()
        _spool[os.getpid()] = Path(tempfile.mkdtemp(prefix="rotorwatch-"))
        atexit.register(_remove, os.getpid(), _spool[os.getpid()])
    return _spool[os.getpid()]


def spooled() -> Path | None:
    """The same, where there is one already."""
    return _spool.get(os.getpid())


def _remove(process: int, folder: Path) -> None:
    import shutil

    if process == os.getpid():
        shutil.rmtree(folder, ignore_errors=True)


def keep(stream: Any, path: Path, name: str, waits: bool = False) -> None:
    """Write all of a binary stream into a file. waits: as long as it takes, as for what another program makes meanwhile.

    Raises LogError when it is more than a log can be or does not come; what reading and writing raise as well.
    """
    size = 0
    with path.open("wb") as file:
        for block in iter(lambda: stream.read(_BLOCK), b"") if waits else _in_time(stream, name):
            size += len(block)
            if size > MOST:
                raise LogError(f"{name} holds more than {MOST >> 30} GB, which no flight log does.")
            file.write(block)


def _in_time(stream: Any, name: str) -> Iterator[bytes]:
    """The blocks of a stream, read by a thread: a read cannot be given up, but one that waits for a thread can."""
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
        while not blocks.empty():  # the thread may wait for room
            blocks.get_nowait()
