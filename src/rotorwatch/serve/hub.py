"""Server-sent events to all open pages: numbered messages from the thread that watches, buffered for pages that reconnect."""

from __future__ import annotations

import asyncio
import secrets
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any

from rotorwatch.live.guard import as_json

RECENT = 400  # messages kept for pages that reconnect: 100 s of them while a vehicle is watched
BEAT_S = 10.0  # interval of empty lines that keep a quiet connection open, and show when it is closed


class Hub:
    """Messages to any number of readers without waiting for any: one that has missed too many gets the whole state again.

    state: the complete state (the key "live" of a new page); called with `lock` held, which must be held for changes of that state, too.
    Thread-safe except `follow`, which belongs to the server's loop."""

    def __init__(self, state: Callable[[], dict[str, Any]]):
        self.lock = threading.RLock()
        self._state = state
        self._run = secrets.token_hex(4)  # distinguishes message numbers of an earlier run of the server
        self._recent: deque[tuple[int, str]] = deque(maxlen=RECENT)
        self._last = 0
        self._bells: set[asyncio.Event] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._closed = False

    def publish(self, kind: str, data: Any) -> None:
        """Send a message to all pages, from any thread."""
        with self.lock:
            self._last += 1
            self._recent.append((self._last, self._frame(kind, data, self._last)))
            loop = self._loop
        if loop is not None and not loop.is_closed():
            loop.call_soon_threadsafe(self._ring)

    def close(self) -> None:
        """End all streams, from any thread."""
        self._closed = True
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._ring)

    async def follow(self, after: str = "") -> AsyncIterator[str]:
        """Server-sent events from now on. after: the identity of the last one that the reader has, or empty."""
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
        """Messages after number `at`, or the whole state when some of them are dropped already; and the number of the last one."""
        with self.lock:
            first = self._recent[0][0] if self._recent else self._last + 1
            if first - 1 <= at <= self._last:
                return "".join(text for number, text in self._recent if number > at), self._last
            return self._frame("state", self._state(), self._last), self._last

    def _frame(self, kind: str, data: Any, number: int) -> str:
        return f"id: {self._run}-{number}\nevent: {kind}\ndata: {as_json(data)}\n\n"

    def _ring(self) -> None:
        for bell in self._bells:
            bell.set()
