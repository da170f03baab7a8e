"""Connections that nobody may sit on: a request's header comes in time, and no address has more than its share of them."""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import ClassVar

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

HEADER_S = 10.0  # from a connection, or the answer before, to the end of a request's header
PER_ADDRESS = 100  # connections; a proxy in front of this server has no more, either


class Connection(H11Protocol):
    """uvicorn's, closed when the header of a request does not come in time."""

    _open: ClassVar[Counter[str]] = Counter()
    _late: asyncio.TimerHandle | None = None

    def connection_made(self, transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._from = self.client[0] if self.client else ""
        self._open[self._from] += 1
        if self._open[self._from] > PER_ADDRESS:
            transport.abort()
        else:
            self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        self._open[self._from] -= 1
        if not self._open[self._from]:
            del self._open[self._from]
        if self._late is not None:
            self._late.cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._watch()

    def _watch(self) -> None:
        """The clock runs while a header is waited for, however many bytes of it come."""
        waits = self.conn.their_state is h11.IDLE
        if waits and self._late is None:
            self._late = self.loop.call_later(HEADER_S, self.transport.close)
        elif not waits and self._late is not None:
            self._late.cancel()
            self._late = None
