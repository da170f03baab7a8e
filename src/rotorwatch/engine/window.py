"""The newest samples of one vehicle. A whole log is an unlimited window; its samples are not copied."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from rotorwatch.flight import Flight, Message, Signal

STATES = ("landed", "armed")
LATE = ("vibration", "clipping", "innovations")  # signals that may arrive late on a link: no measure of the progress of the flight
MOST_MESSAGES = 1000  # largest number of stored messages other than states; the newest are kept


class Growing:
    """The newest samples of one signal. The arrays have twice the length of their content, so that appending is cheap; those of the first
    piece are used as they are until a second one comes."""

    def __init__(self, first: Signal):
        """first: at least one sample."""
        self._like, self._first, self._end = first, 0, len(first)
        self.newest = float(first.time[-1])
        self._time, self._values, self._valid = first.time, first.values, first.valid

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def time(self) -> np.ndarray:
        return self._time[self._first : self._end]

    def add(self, more: Signal) -> None:
        """Append samples; those older than the newest one are dropped."""
        time, values, valid = more.time, more.values, more.valid
        if not time.size:
            return
        if time[0] < self.newest:
            fresh = slice(int(np.searchsorted(time, self.newest)), None)
            time, values, valid = time[fresh], values[fresh], valid[fresh]
            if not time.size:
                return
        if self._end + time.size > len(self._time):
            self._move(max(256, 2 * (len(self) + time.size)))
        part = slice(self._end, self._end + time.size)
        self._time[part], self._values[part], self._valid[part] = time, values, valid
        self._end, self.newest = part.stop, float(time[-1])

    def _move(self, room: int) -> None:
        part = slice(self._first, self._end)
        for name in ("_time", "_values", "_valid"):
            old = getattr(self, name)
            new = np.empty((room, *old.shape[1:]), old.dtype)
            new[: len(self)] = old[part]
            setattr(self, name, new)
        self._first, self._end = 0, part.stop - part.start

    def forget(self, before: float) -> None:
        """Remove older samples, except the last known one before."""
        self._first = self._last_known(before)

    def since(self, start: float) -> Signal:
        """The samples from the last one before `start` on."""
        part = slice(self._last_known(start), self._end)
        return self._like.with_arrays(self._time[part], self._values[part], self._valid[part])

    def _last_known(self, before: float) -> int:
        """Index of the last known sample before a time; of the last one before it where none is known."""
        last = self._first + int(self.time.searchsorted(before)) - 1
        if last <= self._first or self._valid[last].any():  # the usual case
            return max(last, self._first)
        known = np.flatnonzero(self._valid[self._first : last].any(axis=1))
        return self._first + int(known[-1]) if known.size else last


def copied(flight: Flight, **changed) -> Flight:
    """Like `dataclasses.replace`, which takes ten times as long and would run several times a tick."""
    new = object.__new__(Flight)
    new.__dict__.update(flight.__dict__, **changed)
    return new


class Window:
    """The newest samples of one vehicle. about: other facts of the flight (parameters, facts, ...); its signals are not used."""

    def __init__(self, about: Flight):
        self.about = replace(about, signals={}, messages=())
        self._signals: dict[str, Growing] = {}
        self._messages: list[Message] = []
        self.now = -np.inf  # time of the newest sample of any signal, except those of LATE

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """Append samples and messages, in the order of time."""
        for name, signal in signals.items():
            if len(signal):
                growing = self._signals.get(name)
                if growing is None:
                    growing = self._signals[name] = Growing(signal)
                else:
                    growing.add(signal)
                if name not in LATE:
                    self.now = max(self.now, growing.newest)
        self._messages += messages

    def newest(self, name: str) -> float:
        """Time of the newest sample of a signal; minus infinity without one."""
        growing = self._signals.get(name)
        return -np.inf if growing is None else growing.newest

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._signals)

    def flight(self, start: float, names: Iterable[str] | None = None) -> Flight:
        """A flight from the stored samples, from the last ones before `start` on; names: of the signals in it (None: all)."""
        names = self._signals if names is None else [name for name in names if name in self._signals]
        signals = {name: self._signals[name].since(start) for name in names}
        return copied(self.about, signals=signals, duration=max(self.now, 0.0), messages=tuple(self._messages))

    def forget(self, before: float) -> None:
        """Drop older samples, except the last known one of each signal, older messages, except the last of each state, and the oldest of
        too many messages."""
        for growing in self._signals.values():
            growing.forget(before)
        last = {m.kind: m for m in self._messages if m.time < before and m.kind in STATES}
        recent = [m for m in self._messages if m.time >= before]
        texts = sum(m.kind not in STATES for m in recent)
        if texts > MOST_MESSAGES:  # a sender must not fill the memory
            left = itertools.count(texts, -1)
            recent = [m for m in recent if m.kind in STATES or next(left) <= MOST_MESSAGES]
        self._messages = [*last.values(), *recent]
