"""What all open pages are told: numbered messages from the thread that watches, kept for those who come back."""

from __future__ import annotations

import asyncio
import secrets
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any

from rotorwatch.live.guard import as_json

RECENT = 400  # messages for a page that was away for a while: 100 s of them while something is watched
BEAT_S = 10.0  # a line without meaning so often keeps a quiet connection open, and shows when it is gone


class Hub:
    """Messages to any number of readers, none of which is waited for: who has missed too many is told everything anew.

    state: what is to be known without any earlier message (the key "live" of a new page); called with `lock` held, which whoever changes
    that state holds, too. Thread-safe but for `follow`, which belongs to the server's loop.
    """

    def __init__(self, state: Callable[[], dict[str, Any]]):
        self.lock = threading.RLock()
        self._state = state
        self._run = secrets.token_hex(4)  # numbers of an earlier run of the server mean nothing in this one
        self._kept: deque[tuple[int, str]] = deque(maxlen=RECENT)
        self._last = 0
        self._bells: set[asyncio.Event] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._closed = False

    def publish(self, kind: str, data: Any) -> None:
        """Tell all pages, from any thread."""
        with self.lock:
            self._last += 1
            self._kept.append((self._last, self._frame(kind, data, self._last)))
            loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._ring)

    def close(self) -> None:
        """End all streams, from any thread."""
        self._closed = True
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._ring)

    async def follow(self, after: str = "") -> AsyncIterator[str]:
        """Server-sent events from now on. after: the identity of the last one that the reader has, empty for none."""
        self._loop = asyncio.get_running_loop()
        bell = asyncio.Event()
        self._bells.add(bell)
        try:
            yield "retry: 1000\n\n"
            run, _, number = after.partition("-")
            at = int(number) if run == self._run and number.isdecimal() and len(number) < 16 else -1
            while not self._closed:
                bell.clear()
                text, at = self._since(at)
                if text:
                    yield text
                    continue
                try:
                    await asyncio.wait_for(bell.wait(), BEAT_S)
                except asyncio.TimeoutError:
                    yield ": \n\n"
        finally:
            self._bells.discard(bell)

    def _since(self, at: int) -> tuple[str, int]:
        """What has come after message `at`, all of it when some of that is gone; and the number of the last one."""
        with self.lock:
            first = self._kept[0][0] if self._kept else self._last + 1
            if first - 1 <= at <= self._last:
                return "".join(text for number, text in self._kept if number > at), self._last
            return self._frame("state", self._state(), self._last), self._last

    def _frame(self, kind: str, data: Any, number: int) -> str:
        return f"id: {self._run}-{number}\nevent: {kind}\ndata: {as_json(data)}\n\n"

    def _ring(self) -> None:
        for bell in self._bells:
            bell.set()
