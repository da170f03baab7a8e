"""The loop over all endpoints: data in, alerts and a live table of all vehicles out."""

from __future__ import annotations

import gc
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from rotorwatch.errors import RotorwatchError
from rotorwatch.live.guard import Guard, trouble
from rotorwatch.live.watched import Notify, Watched

SHOW_S, WAIT_S, STEP_S = 0.25, 0.005, 0.05
FIRST_S, LONGEST_S = 0.25, 10.0  # before a failed source is retried: doubled each time


class Source(Protocol):
    """A source of vehicles' data."""

    @property
    def vehicles(self) -> Sequence[Watched]:
        """The vehicles received so far."""
        ...

    def poll(self, wait_s: float) -> bool:
        """Read pending data, waiting up to wait_s, and update the vehicles; False when there will be no more."""
        ...

    def shown(self) -> Sequence[tuple[Watched, str]]:
        """Each vehicle with its missing data."""
        ...

    def leave(self) -> None:
        """Stop watching."""
        ...


class Outlet(Protocol):
    """A destination of alerts besides standard output."""

    def take(self, alert: dict) -> None:
        """Accept an alert; must not block."""
        ...

    def step(self, sources: Sequence[Source]) -> None:
        """Called periodically by the loop; must not block."""
        ...

    def leave(self) -> None:
        """Called at the end."""
        ...


class Guarded:
    """A source whose errors cannot affect the others. A RotorwatchError ends it; any other error is reported, and it is retried.

    trouble: why it is not watched, in a sentence, empty while it is. ended: for good. why: the first error."""

    def __init__(self, name: str, source: Source, notify: Notify):
        self.name, self.source, self._notify = name, source, notify
        self.ended, self.trouble = False, ""
        self.why: Exception | None = None
        self._reported, self._again, self._pause = "", -math.inf, 0.0

    @property
    def vehicles(self) -> Sequence[Watched]:
        return self.source.vehicles

    def shown(self) -> Sequence[tuple[Watched, str]]:
        return self.source.shown()

    def poll(self, wait_s: float) -> bool:
        """The source's `poll`, with errors handled."""
        now = time.monotonic()
        if now < self._again:
            time.sleep(wait_s)
            return True
        try:
            self.ended = not self.source.poll(wait_s)
        except Exception as why:
            self.ended = isinstance(why, RotorwatchError)
            self._pause = min(2.0 * self._pause or FIRST_S, LONGEST_S)
            self._again = now + self._pause
            self._fail(why)
        else:
            self.trouble = ""
            if self._pause and now > self._again + LONGEST_S:
                self._reported, self._pause = "", 0.0
        return not self.ended

    def leave(self) -> None:
        try:
            self.source.leave()
        except Exception as why:
            self._fail(why)
        self.ended = True

    def _fail(self, why: Exception) -> None:
        self.why = self.why or why
        self.trouble = trouble(why)
        if self.trouble != self._reported:
            self._reported = self.trouble
            self._notify({"type": "error", "vehicle": self.name, "text": self.trouble})


def watch(
    sources: Sequence[Guarded], show: Callable[[Sequence[Source]], None] | None = None, seconds: float = math.inf,
    outlets: Sequence[Outlet] = (), guard: Guard | None = None, ends: Callable[[], bool] = lambda: False,
) -> None:  # fmt: skip
    """Watch until all sources have ended, for so many seconds, until `ends`, or until the program is asked to end.

    show: called with the sources a few times a second. outlets: called by the loop; alerts reach them by the sources' `notify`. guard:
    runs everything but the evaluation.
    """
    guard = Guard(lambda text: None) if guard is None else guard
    watched = [source.source for source in sources]
    gc.collect()
    gc.freeze()  # loaded modules stay: collecting them repeatedly would stop the evaluation for tenths of a second
    alive, last_shown, stepped, began = list(sources), 0.0, 0.0, time.monotonic()
    with _end_requested() as requested:
        try:
            while alive and not requested and not ends() and time.monotonic() - began < seconds:
                alive = [source for source in alive if source.poll(WAIT_S / len(alive))]
                now = time.monotonic()
                if outlets and now - stepped > STEP_S:
                    stepped = now
                    for outlet in outlets:
                        guard.run(_name(outlet), outlet.step, watched)
                if show is not None and now - last_shown > SHOW_S:
                    guard.run("the picture", show, watched)
                    last_shown = now
        except KeyboardInterrupt:
            pass
        finally:
            gc.unfreeze()
            for source in sources:
                source.leave()
            for outlet in outlets:
                guard.run(_name(outlet), outlet.leave)
            if show is not None:
                guard.run("the picture", show, watched)


def _name(outlet: Outlet) -> str:
    return type(outlet).__name__.lower()


@contextmanager
def _end_requested() -> Iterator[list[int]]:
    """A list that becomes non-empty once the program is asked to end: by Ctrl-C, by SIGTERM, or as its terminal is closed. Nothing is
    interrupted, so that the last alert of each vehicle can be sent; a second signal ends it at once."""
    requested: list[int] = []

    def on_signal(number: int, frame: object) -> None:
        requested.append(number)
        if len(requested) > 1:
            raise KeyboardInterrupt

    before = {}
    if threading.current_thread() is threading.main_thread():
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)
            # Ignored signals stay ignored: of a command in the background, or under nohup.
            if number is not None and signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, on_signal)
    try:
        yield requested
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
