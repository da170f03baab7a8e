"""The loop over all endpoints: data in, alerts and a picture of all vehicles out."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from rotorwatch.live.watched import Watched, trouble

SHOW_S, WAIT_S, STEP_S = 0.25, 0.005, 0.05


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


class Outlet(Protocol):
    """Something that alerts go to besides standard output."""

    def take(self, alert: dict) -> None:
        """One alert; must not wait."""
        ...

    def step(self, sources: Sequence[Source]) -> None:
        """Called by the loop again and again; must not wait."""
        ...

    def leave(self) -> None:
        """Nothing will come after."""
        ...


class Beside:
    """An outlet whose trouble ends nothing else. tell: called with one sentence about it, once."""

    def __init__(self, outlet: Outlet, tell: Callable[[str], None]):
        self._outlet, self._tell, self._told = outlet, tell, False

    def take(self, alert: dict) -> None:
        self._do(self._outlet.take, alert)

    def step(self, sources: Sequence[Source]) -> None:
        self._do(self._outlet.step, sources)

    def leave(self) -> None:
        self._do(self._outlet.leave)

    def _do(self, what: Callable, *given) -> None:
        try:
            what(*given)
        except Exception as why:
            if not self._told:
                self._told = True
                self._tell(f"{type(self._outlet).__name__.lower()}: {trouble(why)}")


def watch(
    sources: Sequence[Source], show: Callable[[Sequence[Source]], None] | None = None, seconds: float = math.inf,
    outlets: Sequence[Outlet] = (),
) -> None:  # fmt: skip
    """Watch until all sources have ended, for so many seconds, or until interrupted. show: called with them a few times a second.
    outlets: get the loop's turns; alerts come to them by the sources' `tell`."""
    gc.collect()
    gc.freeze()  # what is loaded stays: looking through it for garbage again and again would stop the judging for tenths of a second
    alive, shown, stepped, began = list(sources), 0.0, 0.0, time.monotonic()
    try:
        while alive and time.monotonic() - began < seconds:
            alive = [source for source in alive if source.poll(WAIT_S / len(alive))]
            now = time.monotonic()
            if outlets and now - stepped > STEP_S:
                stepped = now
                for outlet in outlets:
                    outlet.step(sources)
            if show is not None and now - shown > SHOW_S:
                show(sources)
                shown = now
    except KeyboardInterrupt:
        pass
    finally:
        gc.unfreeze()
        for source in sources:
            source.leave()
        for outlet in outlets:
            outlet.leave()
        if show is not None:
            show(sources)
