"""Definitions of found, named, right, delay and false alarm, for every published figure.

An alarm is an event that accuses rotors. One that was raised before the fault, or in a flight without any, is a false alarm. After the
onset an alarm is the fault's when a broken rotor is among its explanations, else it is wrong. The fault is

    found      when an alarm is the fault's; its delay is that of the first one, in s from the onset
    named      when the broken rotors, all of them and no other, are an explanation of that alarm
    right      when they are its only one, and no alarm came between

An answer to a whole flight accuses rotors by an event of ACCUSES without alternatives, or by a verdict `fault` that rests on a comparison
with healthy flights. Its outcome is one of

    clean      nobody is accused, and nothing is in doubt (healthy rotors, or a fault that need not be named)
    doubt      `ambiguous` there
    accused    a healthy rotor of a healthy vehicle is
    right      the broken rotors are accused and nobody else
    extra      they are, and a healthy one or something before the onset as well
    wrong      only healthy ones are
    partly     only some of the broken ones are
    among      `ambiguous`, with the broken rotors among the candidates
    astray     `ambiguous` without them
    missed     neither accused nor among candidates
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

from rotorwatch.flight.diagnosis import Diagnosis, Event
from rotorwatch.flight.kinds import DESYNC, LOSS, OVERRIDE
from rotorwatch.toolkit import Conclusion

ACCUSES = (LOSS, OVERRIDE, DESYNC)
FALSE = ("accused", "extra", "wrong")
"""Outcomes in which a healthy rotor is accused with certainty."""
DOUBTS = ("doubt", "among", "astray")
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


def sure(answer: Diagnosis | Conclusion) -> list[Event]:
    """Events that accuse rotors without an alternative."""
    return [e for e in answer.events if e.kind in ACCUSES and e.rotors and not e.alternatives]


def accused(answer: Diagnosis | Conclusion) -> set[int]:
    """Rotors that the answer accuses with certainty."""
    named = {rotor for event in sure(answer) for rotor in event.rotors}
    if answer.verdict == "fault" and not named:
        return {r.rotor for r in answer.rotors if r.status not in ("healthy", "suspect", "unobservable")}
    return named


def candidates(answer: Diagnosis | Conclusion) -> set[int]:
    """Rotors of any explanation that the answer leaves open."""
    sets = (s for e in answer.events if e.alternatives for s in (e.rotors, *e.alternatives))
    return {r for s in sets for r in s} | {r.rotor for r in answer.rotors if r.status == "suspect"}


def outcome(answer: Diagnosis | Conclusion, broken: Collection[int] = (), onset_s: float = 0.0, nameless: bool = False) -> str:
    """The outcome of an answer; see the module. broken: rotors, from 1, that have a fault from onset_s on; nameless: one that costs no
    thrust, so that it is right where its rotor is named, and clean where nobody is."""
    named, truth, doubt = accused(answer), set(broken), answer.verdict == "ambiguous"
    if not truth:
        return "accused" if named or answer.verdict == "fault" else "doubt" if doubt else "clean"
    if nameless:
        return "wrong" if named - truth else "right" if named & truth else "doubt" if doubt else "clean"
    if named:
        if named - truth:
            return "extra" if named & truth else "wrong"
        early = any(e.detected_s < onset_s - EARLY_S for e in sure(answer))
        return "extra" if early else "right" if named >= truth else "partly"
    return "among" if truth <= candidates(answer) else "astray" if doubt else "missed"


def sized(broken: Collection[int], events: Sequence[Event]) -> tuple[int, float, float, float] | None:
    """(rotor, loss, low, high) of the last of these events that gives a broken rotor's loss."""
    for event in reversed(events):
        for k, rotor in enumerate(event.rotors):
            if event.kind == LOSS and rotor in broken and k < len(event.loss):
                return rotor, event.loss[k], *event.interval[k]
    return None


def holds(low: float, high: float, true: float) -> bool:
    """True if the interval contains the true loss."""
    return low - 1e-9 <= true <= high + 1e-9
