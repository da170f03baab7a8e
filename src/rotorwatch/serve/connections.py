"""Limits on connections to the server: time without a request, and their number."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_S = 10.0  # from its beginning, or the end of an answer, to the end of the next header
MOST, PER_ADDRESS = 512, 256
LET_IN = "rotorwatch.let_in"  # key of a request's scope: whether it has access


class Connection(H11Protocol):
    """uvicorn's connection with these limits, of which it has only one: a pause after an answer, which every byte ends.

    A new connection has priority over one without a request, or with one that lacks access and does not end: where there are too many, the
    one that has waited longest is closed. Only where all have requests under way the new one is answered 503."""

    waits: asyncio.TimerHandle | None = None  # while no request is under way: closes the connection
    since = 0.0  # when it began to wait

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        self._wait()
        for most, whose in ((PER_ADDRESS, self._address), (MOST, None)):
            ours = (c for c in self.connections if isinstance(c, Connection) and whose in (None, c._address))
            crowd = [c for c in ours if not c.transport.is_closing()]
            if len(crowd) <= most:
                continue
            idle = [c for c in crowd if c is not self and c._idle]
            if idle:
                min(idle, key=lambda c: c.since).transport.abort()
            else:
                self.limit_concurrency = 0

    def handle_events(self) -> None:
        super().handle_events()
        if self.cycle is not None and not self.cycle.response_complete:
            self._stop_waiting()

    def on_response_complete(self) -> None:
        self._wait()
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        super().connection_lost(exc)

    @property
    def _idle(self) -> bool:
        """True if closing it loses nothing: no request is under way, or an incomplete one without the token, such as the form's. One with
        something left to write has an answer under way."""
        unknown = self.cycle is not None and self.cycle.more_body and not self.cycle.scope.get(LET_IN)
        return (self.waits is not None or unknown) and not self.transport.get_write_buffer_size()

    @property
    def _address(self) -> str:
        return self.client[0] if self.client else ""

    def _wait(self) -> None:
        self._stop_waiting()
        self.since = self.loop.time()
        self.waits = self.loop.call_later(HEADER_S, self.timeout_keep_alive_handler)

    def _stop_waiting(self) -> None:
        if self.waits is not None:
            self.waits.cancel()
            self.waits = None
