"""A link recorded as a telemetry log: a full disk ends the recording, never the evaluation."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from rotorwatch.base import files

FLUSH_S = 1.0  # longest loss of frames when the computer fails
MOST = 1 << 16  # largest number of waiting bytes


class Record:
    """Frames, each after its time of receipt (https://ardupilot.org/dev/docs/mavlink-tlog.html), in a new file.

    failed: called with a sentence when the file can no longer be written."""

    def __init__(self, path: Path, failed: Callable[[str], None]):
        """Raises ConfigError for a path that cannot be written."""
        self._path, self._failed = path, failed
        # Unbuffered: Python's buffer would retry failed writes, at the latest on closing.
        self._file: int | None = os.open(files.writable(path, "--record", make=True), _FLAGS, 0o666)
        self._waiting = bytearray()
        self._written = time.monotonic()

    def add(self, frame: bytes) -> None:
        """Add a frame just received."""
        if self._file is None:
            return
        self._waiting += int(time.time() * 1e6).to_bytes(8, "big") + frame
        if len(self._waiting) > MOST:
            self._write()

    def step(self) -> None:
        """Write frames that have waited long enough; called periodically."""
        if self._waiting and time.monotonic() - self._written > FLUSH_S:
            self._write()

    def _write(self) -> None:
        """Write all waiting frames; the first error ends the recording."""
        self._written = time.monotonic()
        if self._file is None:
            return
        try:
            left = memoryview(bytes(self._waiting))
            while left:
                left = left[os.write(self._file, left) :]
            self._waiting.clear()
        except OSError as why:
            self._stop(why)

    def _stop(self, why: OSError) -> None:
        self._waiting.clear()
        file, self._file = self._file, None
        if file is not None:
            try:
                os.close(file)
            except OSError:
                pass
        self._failed(f"recording to {self._path} has stopped ({why.strerror or why}): the file ends there; the diagnosis continues")

    def close(self) -> None:
        """Write the rest."""
        self._write()
        if self._file is not None:
            file, self._file = self._file, None
            try:
                os.close(file)
            except OSError as why:
                self._stop(why)


_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
