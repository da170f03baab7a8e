"""Definitions of found, named, right, delay and false alarm, for every published figure.

An alarm is an event that accuses rotors. One that was raised before the fault, or in a flight without any, is a false alarm. After the
onset an alarm is the fault's when a broken rotor is among its explanations, else it is wrong. The fault is

    found      when an alarm is the fault's; its delay is that of the first one, in s from the onset
    named      when the broken rotors, all of them and no other, are an explanation of that alarm
    right      when they are its only one, and no alarm came between
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

from rotorwatch.flight.diagnosis import Event

EARLY_S = 0.3  # an alarm so long before the onset is still the fault's: ticks are windows


class Alarm(NamedTuple):
    """An alarm. detected_s: time at which it was raised. sets: rotor sets that explain it, from 1, the likeliest first. event: None for a
    rule without."""

    detected_s: float
    sets: tuple[tuple[int, ...], ...]
    event: Event | None = None

    def names(self, rotors: Iterable[int]) -> bool:
        """True if one of these rotors is in an explanation."""
        return any(set(explanation) & set(rotors) for explanation in self.sets)


class Count(NamedTuple):
    """Alarms of one flight: false, before the fault; wrong, after it; own, those of the fault. named, right: see the module."""

    false: tuple[Alarm, ...]
    wrong: tuple[Alarm, ...]
    own: tuple[Alarm, ...]
    named: bool
    right: bool
    delay_s: float | None

    @property
    def found(self) -> bool:
        """True if an alarm belongs to the fault."""
        return bool(self.own)


def alarms(events: Iterable[Event]) -> tuple[Alarm, ...]:
    """The alarms among the events of an answer, in the order in which they were raised."""
    accusing = sorted((e for e in events if e.means.accuses and e.rotors), key=lambda e: e.detected_s)
    return tuple(Alarm(e.detected_s, tuple(tuple(sorted(s)) for s in e.explanations), e) for e in accusing)


def count(raised: Sequence[Alarm], broken: Iterable[int] = (), onset_s: float = float("inf")) -> Count:
    """raised: alarms in their order; broken: rotors, from 1, that have a fault from onset_s on."""
    rotors = tuple(sorted(broken))
    false = tuple(a for a in raised if a.detected_s < onset_s - EARLY_S)
    after = tuple(a for a in raised if a.detected_s >= onset_s - EARLY_S)
    own = tuple(a for a in after if a.names(rotors))
    wrong = tuple(a for a in after if not a.names(rotors))
    if not own:
        return Count(false, wrong, own, False, False, None)
    first = own[0]
    right = set(first.sets) == {rotors} and first is after[0]
    return Count(false, wrong, own, rotors in first.sets, right, max(first.detected_s - onset_s, 0.0))
