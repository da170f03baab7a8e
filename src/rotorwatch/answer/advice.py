"""Recommended actions, in sentences: parts to inspect, signals to log, flights to fly. They follow from the answer and change nothing in
it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rotorwatch.answer.unassessed import OUTPUTS
from rotorwatch.answer.wording import BASELINE, listed, rotors, said, seconds, sentence
from rotorwatch.engine.events.decisions import TOTAL_LOSS
from rotorwatch.flight.diagnosis import Event, RotorState
from rotorwatch.flight.kinds import CONTACT, DESYNC, LOST, REPORTED, Weight

AFTER_S = 5.0  # after a blow, or a flight with a loss of control, within which reports are its consequence

# Inspections in the order of their worth: what takes a hand and an eye first, then what takes a tool.
PARTS = {
    "propeller": "the propeller first (nicked, bent, loose on its shaft); the motor turns as commanded",
    "motor_or_esc": "turn the motor by hand, then ESC, connectors and supply wires; the motor turns slower than commanded",
    "bearing": "turn the motor by hand, the motor bearings first; the motor draws more current than its speed needs",
}
GONE = "is the propeller there, whole and tight; turn the motor by hand; then its ESC and the wires between them"
RECOVERED = "it recovered by itself, so look first for a loose connector or a cold solder joint, then an ESC desync or a hot motor"
WEAK = "turn it by hand (rough or stiff: its bearing), look at its propeller (leading edges, seat), then at its ESC's connectors"

SENSORS = "Use another log of this vehicle; `rotorwatch info LOG` lists the signals of this one, their sources and their valid shares."


class Advice(NamedTuple):
    """checks: what to inspect, in the order of its worth. surer: what to log or fly for a surer answer. Sentences."""

    checks: tuple[str, ...]
    surer: tuple[str, ...]


def advise(
    verdict: str,
    events: Sequence[Event],
    main: int | None,
    states: Sequence[RotorState],
    compared: bool,
    places: Sequence[str],
    doubts: Sequence[str],
    stays: bool = True,
    missing: bool = False,
    shows_more: str = "",
    settings: str = "",
) -> Advice:
    """Recommended actions. compared: with healthy flights, or it cannot be; stays: the main event was not over before the landing; missing:
    commands, up to the end of the flight; shows_more: how the next log can show what this one did not; settings: that log what this log
    lacks."""
    checks: list[str] = []
    surer: list[str] = []
    event = None if main is None else events[main]
    broken = [s.rotor for s in states if s.status in ("degraded", "failed")]
    suspects = [s.rotor for s in states if s.status == "suspect"]
    if doubts or missing:
        surer += [sentence(d) for d in doubts[1:]]
        surer.append(OUTPUTS if missing or "output" in doubts[0] else SENSORS)
    elif shows_more:
        surer.append(shows_more)
    first = "" if event is None else _first(event, places, stays)
    if first:
        checks.append(first)
    elif broken:
        checks.append(f"Inspect {rotors(broken, places)} before the next flight: {WEAK}.")
    rest = [r for r in (*broken, *suspects) if event is None or event.alternatives or r not in event.rotors]
    if rest and not (broken and event is None and not suspects):
        likely = [r for own in (() if event is None else event.explanations) for r in own if r in rest]
        who = rotors(dict.fromkeys([*likely, *sorted(rest)]), places)
        how = f" before the next flight: {WEAK}" if not checks else " as well"
        checks.append(f"Inspect {who}{how}.")
    if verdict == "ambiguous" and (event is None or event.kind != DESYNC):
        surer.append(
            "To distinguish the candidates: swap the propellers of the suspects with others and see whether the loss moves with them, "
            "or fly brisk yaw turns and rolls, with a healthy flight of this build as --baseline."
        )
    checks += [
        said(e.means.advice, e, places)
        for e in events
        if e.means.weight is Weight.NOTICE and not (e.kind == REPORTED and _came_of(e, events))
    ]
    why = "its loss grew steadily, as with a worn bearing, a hot motor or a propeller coming loose"
    growing = [s.rotor for s in states if s.trend and s.trend.word == "growing" and s.status in ("healthy", "suspect")]
    checks += [f"Inspect {rotors([rotor], places)} before the next flight: {why}." for rotor in growing]
    outside = [e for e in events if e.means.weight is Weight.OUTSIDE]
    for kind in dict.fromkeys(e.kind for e in outside):
        of_kind = [e for e in outside if e.kind == kind]
        when = listed([seconds(e.onset_s) for e in of_kind[:5]])
        checks.append(said(of_kind[0].means.advice, of_kind[0], places, all_times=when))
    surer += [settings] if settings else []
    if verdict not in ("inconclusive", "crashed") and not compared:
        surer.append(BASELINE)
    return Advice(tuple(dict.fromkeys(checks)), tuple(surer))


def _came_of(report: Event, events: Sequence[Event]) -> bool:
    """True if an autopilot's report follows from a loss of control or a blow, and needs no investigation of its own."""
    return any(
        e.onset_s <= report.onset_s and (e.kind == LOST or (e.kind == CONTACT and report.onset_s < e.onset_s + AFTER_S)) for e in events
    )


CAUSES = {
    "disarmed": "Find out what stopped the motors: a switch, a failsafe, the arming checks; the log's messages say which.",
    "knock": "Inspect the vehicle for damage, and keep clear of what it hit.",
    "controller": "Check sensors, vibration, calibration, the estimator's messages and the pilot's inputs around that time.",
    "saturated": "The vehicle had no thrust margin left: reduce weight, charge the battery, wait for less wind, or fit stronger motors.",
    "power": "Inspect the battery, its connectors and wires, and the power module.",
    "unknown": "Inspect all moving and current-carrying parts before the next flight; log faster: `rotorwatch info LOG` shows how.",
    "rotor": "Inspect propellers, motors and ESCs before the next flight.",
}


def _first(event: Event, places: Sequence[str], stays: bool) -> str:
    """Action for the main event; empty where its suspects' advice covers it."""
    if event.kind == LOST:
        return CAUSES.get(event.extra.get("cause", ""), CAUSES["unknown"])
    return said(event.means.advice, event, places, parts=_parts(event, stays) if event.means.weakens else "")


def _parts(event: Event, stays: bool) -> str:
    if len(event.rotors) == 1 and event.extra.get("cause") in PARTS:
        return PARTS[event.extra["cause"]]
    if not stays:
        return RECOVERED
    return GONE if max(event.loss, default=0.0) > TOTAL_LOSS else WEAK
