"""Whether to fly again, in one of four words, and what explains the finding, the most probable cause first. Both follow from the answer."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rotorwatch.answer.advice import Advice
from rotorwatch.answer.findings import Evidence
from rotorwatch.answer.wording import grows
from rotorwatch.engine.events.decisions import MATTERS
from rotorwatch.flight.diagnosis import Event, Fitness, RotorState
from rotorwatch.flight.kinds import FROM_TAKEOFF, LOSS, LOST, ORDER, Weight

MOST_CHECKS = 3
GRAVE = ("power", "crash", "stopped")  # troubles that end a flight: they lead where no fault is found
UNNAMED = None, "", "unknown", "rotor"  # causes of events that are known by their kind alone
DO_NOT, LOOK, CANNOT, FLY = "do not fly", "look first", "cannot say", "fly"


def assess(verdict: str, events: Sequence[Event], states: Sequence[RotorState], advice: Advice) -> Fitness:
    """The word for an answer. A flight with anything that someone should look at - a blow, a notice, a suspicion, a loss that grows - is
    never fit to fly, whatever its verdict."""
    grave = verdict in ("fault", "crashed") or any(_grounds(e) for e in events)
    suspicion = verdict == "ambiguous" or any(s.status == "suspect" or (s.trend and s.trend.word == "growing") for s in states)
    if grave:
        word = DO_NOT
    elif suspicion or any(e.means.weight is not Weight.OPEN for e in events):
        word = LOOK
    else:
        word = FLY if verdict == "healthy" else CANNOT
    return Fitness(word, advice.checks[:MOST_CHECKS], advice.surer)


def _grounds(event: Event) -> bool:
    """True if an event alone forbids the next flight: control was lost, outputs go to the wrong motors, the autopilot reported a trouble
    that ends a flight, or some rotor has certainly lost an amount that matters, whichever it is."""
    large = event.kind == LOSS and min((low for low, _ in event.interval), default=0.0) > MATTERS
    return event.kind in (LOST, ORDER) or event.extra.get("trouble") in GRAVE or large


def causes(seen: Evidence, main: int | None) -> tuple[Mapping[str, Any], ...]:
    """What explains the answer: {name, rotors, probability, evidence}, as in docs/json.md, the most probable first; those of unknown
    probability last, in the order in which they were found likely. Empty where nothing needs an explanation."""
    return tuple(sorted(_explanations(seen, main), key=lambda c: 1.0 if c["probability"] is None else -c["probability"]))


def _cause(name: str, rotors: Sequence[int], probability: float | None, *evidence: str) -> dict[str, Any]:
    return {"name": name, "rotors": tuple(rotors), "probability": probability, "evidence": tuple(e for e in evidence if e)}


def _explanations(seen: Evidence, main: int | None) -> Iterator[dict[str, Any]]:
    event = None if main is None else seen.events[main]
    for e in [] if event is None else [event, *(e for e in seen.events if e is not event and e.means.accuses)]:
        parts = e.extra.get("causes") or {e.extra.get("cause"): 1.0}
        for part, share in parts.items():
            name = e.kind if part in UNNAMED else part
            yield _cause(name, e.rotors, e.probability * share, e.reason, *e.extra.get("evidence", ()))
        for rotors in e.alternatives:
            yield _cause(LOSS if e.kind == LOST else e.kind, rotors, None, e.reason)
        for report in e.extra.get("before", ()):
            reason = next(r.reason for r in seen.events if r.extra.get("trouble") == report["trouble"] and r.onset_s == report["time_s"])
            yield _cause(report["trouble"], (), None, reason)
    if event is not None and not event.alternatives:
        return
    whole = seen.compared
    if whole and whole["verdict"] in ("fault", "ambiguous"):
        for c in whole["causes"]:
            name = FROM_TAKEOFF if c["rotors"] else c.get("kind") or "usual_trim"
            yield _cause(name, c["rotors"], c["probability"], whole["reason"])
    for spell in seen.unexplained_evidence:
        yield _cause(LOSS, spell.rotors, None, spell.reason)
    if event is None:
        for rotor, trend in seen.growing:
            yield _cause("growing_loss", (rotor,), None, f"rotor {rotor} {grows(trend)}")
