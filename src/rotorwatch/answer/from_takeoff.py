"""Damage from take-off as a claim: the result of comparing a whole flight with healthy flights or vehicles."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight.diagnosis import Event, Source
from rotorwatch.flight.kinds import FROM_TAKEOFF


def _certain(claim: Event, known: Event) -> bool:
    return known.means.accuses and not known.alternatives


def _certain_or_compared(claim: Event, known: Event) -> bool:
    return known.source.name == FLIGHTS.name or _certain(claim, known)


FLIGHTS = Source("healthy flights", 13, _certain)  # of this vehicle
VEHICLES = Source("healthy vehicles", 14, _certain_or_compared)  # of any build


def claims(found: Mapping[str, Any] | None, source: Source, air: Spans) -> tuple[Event, ...]:
    """The result (`WholeFlight.to_dict`, `population.assess`) as a claim, with all of it in `extra`; none where nothing could be compared.
    air: the flights."""
    if found is None or found["verdict"] == "inconclusive":
        return ()
    who = tuple(found["rotors"])
    shares = {tuple(c["rotors"]): c["probability"] for c in found.get("causes", ())}
    others = tuple(rotors for rotors in shares if rotors and rotors != who) if found["verdict"] == "ambiguous" else ()
    size, interval = tuple(found["loss"][r - 1] for r in who), tuple(tuple(found["interval"][r - 1]) for r in who)
    span = air[0][0], air[-1][1], None
    return (Event(FROM_TAKEOFF, who, *span, size, interval, shares.get(who, 0.0), others, found["reason"], found, source),)
