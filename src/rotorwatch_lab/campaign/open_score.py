"""Scores the answer of `diagnose` to one simulated flight; the outcomes are those of `counting`, and `error` for a log that is refused."""

from __future__ import annotations

from typing import Any

from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.flight.kinds import CAPPED, LOSS, OVERRIDE, SLOW_RESPONSE, STANDS_APART, TURNED, UNEVEN
from rotorwatch.toolkit import Conclusion
from rotorwatch_lab.experiments import counting
from rotorwatch_lab.experiments.counting import DOUBTS as DOUBTS
from rotorwatch_lab.experiments.counting import FALSE as FALSE
from rotorwatch_lab.simulation.scenario import Scenario

LOSSES = ("loss", "complete loss", "chipped", "weak motor", "float")
KINDS = {
    "tilt": (TURNED, UNEVEN), "slow": (SLOW_RESPONSE,), "stuck": (OVERRIDE, LOSS), "capped": (CAPPED, OVERRIDE, LOSS),
    "strong": (STANDS_APART,),
}  # fmt: skip
"""Fault that is no loss -> kinds of events that name it: of a capped or stuck rotor the loss that it causes, too."""
NAMED_OR_NOT = ("strong", "tilt")
"""Faults that cost no thrust: right when their rotor is named, clean when nobody is."""


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


def assessed(scenario: Scenario, answer: Diagnosis | Conclusion) -> dict[str, Any]:
    """The columns of `open_world` that depend on the answer: outcome, accused, and, where defined, delay_s, error, holds and ended."""
    truth = {f["rotor"] for f in scenario.faults}
    onset = min((f["onset_s"] for f in scenario.faults), default=0.0)
    nameless = all(f["kind"] in NAMED_OR_NOT for f in scenario.faults)
    row: dict[str, Any] = {
        "accused": "+".join(map(str, sorted(counting.accused(answer)))), "outcome": counting.outcome(answer, truth, onset, nameless)
    }  # fmt: skip
    if group(scenario) == "other":
        meant = {kind for f in scenario.faults for kind in KINDS.get(f["kind"], ())}
        row["named"] = row["outcome"] not in counting.FALSE and any(e.kind in meant for e in answer.events)
    rightful = [e for e in counting.sure(answer) if set(e.rotors) & truth and e.detected_s >= onset - counting.EARLY_S]
    if not rightful:
        return row
    row["delay_s"] = max(min(e.detected_s for e in rightful) - onset, 0.0)
    if all(f["end_s"] is None and f["period_s"] is None for f in scenario.faults):
        row["ended"] = all(r.status == "healthy" for r in answer.rotors if r.rotor in truth)
    true = losses(scenario)
    if size := counting.sized(true, rightful):
        rotor, loss, low, high = size
        row |= {"error": float(loss - true[rotor]), "holds": counting.holds(low, high, true[rotor])}
    return row
