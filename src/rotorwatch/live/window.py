"""The last seconds of a flight's signals, as they grow: what causal functions need to go on from where they were."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from rotorwatch.flight import Flight, Message, Signal

WINDOW_S = 8.0  # the longest look back is two seconds; what is late or waited for comes on top
STATES, DISARMED = ("landed", "armed"), "disarmed: "  # and the event that says why


class Growing:
    """The newest samples of one signal. Room is kept for twice of what is in it, so that adding is cheap."""

    def __init__(self, like: Signal):
        self._like, self._first, self._end = like, 0, 0
        self.newest = -np.inf  # time of the last sample
        self._time = np.empty(256)
        self._values = np.empty((256, like.values.shape[1]))
        self._valid = np.empty(self._values.shape, bool)

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def time(self) -> np.ndarray:
        return self._time[self._first : self._end]

    def add(self, more: Signal) -> None:
        """More samples; those that are older than the newest one are left out."""
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
        """Drop what is older, but for the last sample of it that is known."""
        self._first = self._last_known(before)

    def since(self, start: float) -> Signal:
        """The samples from the last one before `start` on."""
        part = slice(self._last_known(start), self._end)
        return self._like.with_arrays(self._time[part], self._values[part], self._valid[part])

    def _last_known(self, before: float) -> int:
        """Place of the last sample before a time that is known; of the last one at all where none is."""
        last = self._first + int(self.time.searchsorted(before)) - 1
        if last <= self._first or self._valid[last].any():  # the rule
            return max(last, self._first)
        known = np.flatnonzero(self._valid[self._first : last].any(axis=1))
        return self._first + int(known[-1]) if known.size else last


def copied(flight: Flight, **changed) -> Flight:
    """As `dataclasses.replace`, which takes ten times as long, several times a tick."""
    new = object.__new__(Flight)
    new.__dict__.update(flight.__dict__, **changed)
    return new


class Window:
    """The newest samples of one vehicle. about: what is known of the flight besides (parameters, facts, ...); its signals are not used."""

    def __init__(self, about: Flight):
        self.about = replace(about, signals={}, messages=())
        self._signals: dict[str, Growing] = {}
        self._messages: list[Message] = []
        self.now = -np.inf  # time of the newest sample of any signal

    def add(self, signals: Mapping[str, Signal], messages: Iterable[Message] = ()) -> None:
        """More of a flight, in time order."""
        for name, signal in signals.items():
            if len(signal):
                growing = self._signals.get(name)
                if growing is None:
                    growing = self._signals[name] = Growing(signal)
                growing.add(signal)
                self.now = max(self.now, growing.newest)
        self._messages += [m for m in messages if m.kind in STATES or m.text.startswith(DISARMED)]

    def newest(self, name: str) -> float:
        """Time of the newest sample of a signal; minus infinity without one."""
        growing = self._signals.get(name)
        return -np.inf if growing is None else growing.newest

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._signals)

    def flight(self, start: float, names: Iterable[str] | None = None) -> Flight:
        """A flight of what is kept, from the last samples before `start` on; names: of the signals in it (None: all)."""
        names = self._signals if names is None else [name for name in names if name in self._signals]
        signals = {name: self._signals[name].since(start) for name in names}
        return copied(self.about, signals=signals, duration=max(self.now, 0.0), messages=tuple(self._messages))

    def forget(self, before: float) -> None:
        """Drop what is older, but for the last known sample of each signal and the last word of each kind."""
        for growing in self._signals.values():
            growing.forget(before)
        last = {m.kind: m for m in self._messages if m.time < before}
        self._messages = [*last.values(), *(m for m in self._messages if m.time >= before)]
