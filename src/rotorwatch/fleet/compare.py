"""Two flights of a store side by side: their answers, and the differences.

Differences between any two flights (start, length) are shown but not marked. Losses differ where their 95 % intervals do not overlap, or
where one rotor is called healthy and the other is not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from rotorwatch import report
from rotorwatch.errors import ConfigError, NotInStore
from rotorwatch.fleet.store import Store
from rotorwatch.flight.diagnosis import Diagnosis, Event, RotorState

SAME_VOLTAGE = 0.03  # relative; thrust at the same command, and so the hover command, goes with its square


@dataclass(frozen=True)
class Row:
    """A line of the comparison. what: its name; values: in words, of either flight; differs: whether to mark it."""

    what: str
    values: tuple[str, str]
    differs: bool


@dataclass(frozen=True)
class Moment:
    """An event in words. onset_s: when it began; alone: the other flight has none of its kind and rotors."""

    text: str
    onset_s: float
    alone: bool


@dataclass(frozen=True)
class Comparison:
    """flights: the rows of the store, with `diagnosis`; answers: the same as `Diagnosis`. facts, rotors: lines; events: of either flight;
    headline: the differences, a sentence."""

    flights: tuple[dict[str, Any], dict[str, Any]]
    answers: tuple[Diagnosis, Diagnosis]
    facts: tuple[Row, ...]
    rotors: tuple[Row, ...]
    events: tuple[tuple[Moment, ...], tuple[Moment, ...]]
    headline: str

    def to_dict(self) -> dict[str, Any]:
        """Plain data, for JSON (docs/fleet.md)."""
        short = ("hash", "name", "utc", "aircraft_name", "verdict", "headline", "loss", "duration_s", "version")
        return {
            "headline": self.headline,
            "flights": [{name: flight[name] for name in short} for flight in self.flights],
            "facts": [vars(row) for row in self.facts],
            "rotors": [vars(row) for row in self.rotors],
            "events": [[vars(event) for event in events] for events in self.events],
        }


def compare(store: Store, a: str, b: str) -> Comparison:
    """Flights a and b, by their hashes or at least their first 6 digits. Raises NotInStore, and ConfigError for a flight and itself or an
    answer of an unsupported version."""
    flights = tuple(_found(store, hash) for hash in (a, b))
    if flights[0]["hash"] == flights[1]["hash"]:
        raise ConfigError("This is one flight; choose two different ones to compare.")
    answers = tuple(Diagnosis.from_dict(flight["diagnosis"]) for flight in flights)
    facts = tuple(Row(what, (of(0), of(1)), differs) for what, of, differs in _facts(flights, answers))
    rotors = tuple(_rotors(answers))
    events = tuple(tuple(_events(one, other)) for one, other in (answers, answers[::-1]))
    return Comparison(flights, answers, facts, rotors, events, _headline(facts, rotors, events))  # type: ignore[arg-type]


def _found(store: Store, hash: str) -> dict[str, Any]:
    flight = store.flight(hash)
    if flight is None:
        raise NotInStore("The store has no flight with such a hash, or several.")
    return flight


def _facts(flights: Any, answers: Any) -> Iterable[tuple[str, Callable[[int], str], bool]]:
    """(name, words of flight 0 or 1, whether they differ) of all but rotors and events."""

    def line(what: str, of: Callable[[int], str], marked: bool = True):
        return what, of, marked and of(0) != of(1)

    def fact(name: str) -> Callable[[int], str]:
        return lambda k: str(answers[k].flight.get(name) or "not known")

    yield line("verdict", lambda k: report.VERDICTS[answers[k].verdict])
    yield line("aircraft", lambda k: flights[k]["aircraft_name"] or "not known")
    yield line("frame", lambda k: report.frame(answers[k]))
    yield line("autopilot", fact("autopilot"))
    yield line("firmware", fact("firmware"))
    yield line("began", lambda k: report.day(answers[k]) or "not known", False)
    yield line("duration", lambda k: f"{flights[k]['duration_s']:.1f} s", False)
    yield line("in the air", lambda k: f"{flights[k]['airborne_s']:.1f} s", False)
    volts = [float(flight["trim"].get("voltage") or 0.0) for flight in flights]
    unlike = abs(volts[0] - volts[1]) > SAME_VOLTAGE * max(volts)
    yield "battery in hover", lambda k: f"{volts[k]:.1f} V" if volts[k] else "not known", unlike and min(volts) > 0.0
    yield line("logging", fact("profile"))
    yield line("compared with", lambda k: answers[k].baseline)
    yield line("warnings", lambda k: str(len(answers[k].warnings)), False)
    yield line("diagnosed by", lambda k: f"rotorwatch {flights[k]['version']}")


def _rotors(answers: tuple[Diagnosis, ...]) -> Iterable[Row]:
    states = [{r.rotor: r for r in answer.rotors} for answer in answers]
    for number in sorted({*states[0], *states[1]}):
        one, other = (of.get(number) for of in states)
        places = [state.place for state in (one, other) if state]
        alike = len(set(places)) == 1
        where = f" ({places[0]})" if alike and places[0] else ""
        values = (_rotor(one, not alike), _rotor(other, not alike))
        yield Row(f"rotor {number}{where}", values, one is not None and other is not None and _unlike(one, other))


def _rotor(state: RotorState | None, with_place: bool) -> str:
    """with_place: where the other flight has this rotor elsewhere."""
    if state is None:
        return "no such rotor"
    loss, interval = report.rotor_loss(state), report.rotor_interval(state)
    parts = [state.place if with_place else "", state.status, "" if loss == "?" else loss]
    return ", ".join(filter(None, parts)) + (f" ({interval})" if interval else "")


def _unlike(one: RotorState, other: RotorState) -> bool:
    if one.status != other.status:
        return True
    return max(one.interval[0], other.interval[0]) > min(one.interval[1], other.interval[1])


def _events(answer: Diagnosis, other: Diagnosis) -> Iterable[Moment]:
    def mark(e: Event) -> tuple:
        return e.kind, tuple(e.rotors)

    known = {mark(e) for e in other.events}
    for e in answer.events:
        losses = f", {report.losses(e)}" if e.loss else ""
        until = f" to {report.seconds(e.end_s)}" if e.end_s is not None else ""
        text = f"{report.sentence(e.means.noun)}: {report.who(e, answer)}{losses}, {report.seconds(e.onset_s)}{until}"
        yield Moment(text, float(e.onset_s), mark(e) not in known)


def _headline(facts: Sequence[Row], rotors: Sequence[Row], events: Any) -> str:
    """The differences, the most important first."""
    alone = Row("events", ("", ""), any(event.alone for of in events for event in of))
    unlike = [row.what for row in (*facts[:1], *rotors, alone, *facts[1:]) if row.differs]
    return f"They differ in {report.listed(unlike)}." if unlike else "The answers agree within their intervals."
