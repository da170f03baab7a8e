"""The loop over all endpoints: data in, alerts and a picture of all vehicles out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Protocol

from rotorwatch.live.watched import Watched

SHOW_S = 0.25


class Source(Protocol):
    """Something that vehicles are heard through."""

    @property
    def vehicles(self) -> Sequence[Watched]:
        """Those that have been heard so far."""
        ...

    def poll(self) -> bool:
        """Take what has come, waiting a moment at most; False when there will be no more."""
        ...


def watch(sources: Sequence[Source], show: Callable[[Sequence[Source]], None] | None = None) -> None:
    """Watch until all sources have ended. show: called with them a few times a second."""
    alive, shown = list(sources), 0.0
    while alive:
        alive = [source for source in alive if source.poll()]
        if show is not None and time.monotonic() - shown > SHOW_S:
            show(sources)
            shown = time.monotonic()
    if show is not None:
        show(sources)
