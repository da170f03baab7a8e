"""Scores the answer of `diagnose` to one flight: rotors accused with certainty, rightly or not.

A rotor is accused by an event of one of ACCUSES that names it without alternatives, or by a verdict `fault` that rests on a comparison.

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
    error      the log is refused
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rotorwatch.flight.diagnosis import Diagnosis, Event
from rotorwatch.flight.kinds import DESYNC, LOSS, OVERRIDE
from rotorwatch.toolkit import Conclusion
from rotorwatch_lab.experiments.counting import EARLY_S
from rotorwatch_lab.simulation.scenario import Scenario

ACCUSES = (LOSS, OVERRIDE, DESYNC)
LOSSES = ("loss", "complete loss", "chipped", "weak motor", "float")
NAMED_OR_NOT = ("strong", "tilt")
"""Faults that cost no thrust: right when their rotor is named, clean when nobody is."""
FALSE = ("accused", "extra", "wrong")
"""Outcomes in which a healthy rotor is accused with certainty."""
DOUBTS = ("doubt", "among", "astray")


def group(scenario: Scenario) -> str:
    """Group of the scenario: healthy, loss, or other."""
    if not scenario.faults:
        return "healthy"
    return "loss" if all(f["kind"] in LOSSES for f in scenario.faults) else "other"


def losses(scenario: Scenario) -> dict[int, float]:
    """Rotor -> true loss at the end of the flight, of the faults whose size is one; rotors count from 1."""
    lost: dict[int, float] = {}
    for f in scenario.faults:
        if f["kind"] in ("loss", "chipped", "complete loss", "float"):
            grown = min(1.0, (scenario.duration_s - f["onset_s"]) / f["ramp_s"]) if f["ramp_s"] else 1.0
            size = f["strength"] if f["kind"] in ("loss", "chipped") else 1.0
            lost[f["rotor"]] = 1.0 - (1.0 - lost.get(f["rotor"], 0.0)) * (1.0 - size * grown)
    return lost


def accused(answer: Diagnosis | Conclusion) -> set[int]:
    """Rotors that the answer accuses with certainty."""
    named = {rotor for event in _sure(answer) for rotor in event.rotors}
    if answer.verdict == "fault" and not named:
        return {r.rotor for r in answer.rotors if r.status not in ("healthy", "suspect", "unobservable")}
    return named


def _sure(answer: Diagnosis | Conclusion) -> list[Event]:
    return [e for e in answer.events if e.kind in ACCUSES and e.rotors and not e.alternatives]


def _candidates(answer: Diagnosis | Conclusion) -> set[int]:
    sets = (s for e in answer.events if e.alternatives for s in (e.rotors, *e.alternatives))
    return {r for s in sets for r in s} | {r.rotor for r in answer.rotors if r.status == "suspect"}


def judged(scenario: Scenario, answer: Diagnosis | Conclusion) -> dict[str, Any]:
    """The columns of `open_world` that depend on the answer: outcome, accused, and, where defined, delay_s, error, holds and ended."""
    named, truth = accused(answer), {f["rotor"] for f in scenario.faults}
    onset = min((f["onset_s"] for f in scenario.faults), default=0.0)
    sure = _sure(answer)
    early = any(e.detected_s < onset - EARLY_S for e in sure)
    row: dict[str, Any] = {"accused": "+".join(map(str, sorted(named))), "outcome": _outcome(scenario, answer, named, truth, early)}
    rightful = [e for e in sure if set(e.rotors) & truth and e.detected_s >= onset - EARLY_S]
    if not rightful:
        return row
    row["delay_s"] = max(min(e.detected_s for e in rightful) - onset, 0.0)
    if all(f["end_s"] is None and f["period_s"] is None for f in scenario.faults):
        row["ended"] = all(r.status == "healthy" for r in answer.rotors if r.rotor in truth)
    return row | _size(losses(scenario), rightful)


def _outcome(scenario: Scenario, answer: Diagnosis | Conclusion, named: set[int], truth: set[int], early: bool) -> str:
    doubt = answer.verdict == "ambiguous"
    if not truth:
        return "accused" if named or answer.verdict == "fault" else "doubt" if doubt else "clean"
    if all(f["kind"] in NAMED_OR_NOT for f in scenario.faults):
        return "wrong" if named - truth else "right" if named & truth else "doubt" if doubt else "clean"
    if named:
        if named - truth:
            return "extra" if named & truth else "wrong"
        return "extra" if early else "right" if named >= truth else "partly"
    return "among" if truth <= _candidates(answer) else "astray" if doubt else "missed"


def _size(true: Mapping[int, float], events: list[Event]) -> dict[str, Any]:
    """error and holds, of the last event that has a size of a broken rotor."""
    for event in reversed(events):
        for k, rotor in enumerate(event.rotors):
            if event.kind == LOSS and rotor in true and k < len(event.loss):
                low, high = event.interval[k]
                return {"error": float(event.loss[k] - true[rotor]), "holds": bool(low - 1e-9 <= true[rotor] <= high + 1e-9)}
    return {}
