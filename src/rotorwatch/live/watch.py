"""The loop over all endpoints: data in, alerts and a picture of all vehicles out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from rotorwatch.live.watched import Watched

SHOW_S, WAIT_S = 0.25, 0.005


class Source(Protocol):
    """Something that vehicles are heard through."""

    @property
    def vehicles(self) -> Sequence[Watched]:
        """Those that have been heard so far."""
        ...

    def poll(self, wait_s: float) -> bool:
        """Take what has come, waiting for it so long at most; False when there will be no more."""
        ...

    def shown(self) -> Sequence[tuple[Watched, str]]:
        """Each vehicle with what is not known of it yet."""
        ...

    def leave(self) -> None:
        """Watched no longer."""
        ...


def watch(
    sources: Sequence[Source], show: Callable[[Sequence[Source]], None] | None = None, seconds: float = math.inf
) -> None:
    """Watch until all sources have ended, for so many seconds, or until interrupted. show: called with them a few times a second."""
    alive, shown, began = list(sources), 0.0, time.monotonic()
    try:
        while alive and time.monotonic() - began < seconds:
            alive = [source for source in alive if source.poll(WAIT_S / len(alive))]
            if show is not None and time.monotonic() - shown > SHOW_S:
                show(sources)
                shown = time.monotonic()
    except KeyboardInterrupt:
        pass
    finally:
        for source in sources:
            source.leave()
        if show is not None:
            show(sources)
