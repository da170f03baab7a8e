"""The parts of the diagnosis that other packages may build on, under names that stay when the modules behind them move.

`rotorwatch_lab` uses rotorwatch by this module, by `toolkit.commands` for its command line, and by the modules that hold data and
conventions: `rotorwatch` itself, `.core`, `.errors`, `.flight`, `.airframes`, `.logs`, `.base`, `.stats`, `.detectors` and `.report`.

diagnosis       diagnose, and its stages prepare -> Case, estimated -> Estimated, `Case.by` and `Case.answer`; Estimation, of an entry
                point `rotorwatch.estimation`; Conclusion, of an answer; events, what estimates announce; baselines, healthy flights that
                are given
flight          airborne; observe -> Ticks, with the modes GROUND, LEARN and ASSESS and the times READY_S, READY_KNOWN_S, HOVER_LEARN_S and
                LAG_S; cut_ticks; allocation: commands, thrusts and geometry; ambiguous_sets; attainable: thrusts and moments that a
                vehicle can give; aerobatic: vehicles that do not hover; esc_telemetry
estimator       program: the default estimator over ticks, TickOutput; list_hypotheses, rotor_sets; the states of its plant and the prior
                of losses, in capitals; ENGINE, its compiled definition, and DEFINITIONS, the modules that hold its constants
comparison      odds: explanations of a claim, their weights and probabilities; witness: all that are asked, and others in their place
excitation      excitation_response: the answer to it; null_space, ExcitationNoise, noise_covariance
export, fleet   export_default; Exported and saved, a C project in a folder; Store, assess, flight_result, prognosis

Each name is loaded when it is first asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

_PLACES = {
    "AIR": "engine.estimator.plant:AIR",
    "ANNOUNCED_TICKS": "engine.estimator.announcement:TICKS",
    "Conclusion": "answer.conclusion:Conclusion",
    "DAMPING": "engine.estimator.plant:DAMPING",
    "ENGINE": "engine.definition:ENGINE",
    "Case": "case.conductor:Case",
    "Estimated": "case.estimated:Estimated",
    "Estimation": "diagnose:Estimation",
    "ExcitationNoise": "witnesses.null_space:Noise",
    "Exported": "export.projects:Exported",
    "GAIN": "engine.estimator.plant:GAIN",
    "GROUND": "engine.motion.tick_table:GROUND",
    "Given": "witnesses.healthy.baselines:Given",
    "HOVER_LEARN_S": "engine.motion.tick_table:HOVER_LEARN_S",
    "Hypotheses": "engine.bindings.hypothesis_list:Hypotheses",
    "ASSESS": "engine.motion.tick_table:ASSESS",
    "LAG_S": "engine.motion.tick_table:LAG_S",
    "LEARN": "engine.motion.tick_table:LEARN",
    "LOSS_WIDTH": "engine.estimator.hypotheses:LOSS_WIDTH",
    "NOTHING": "engine.estimator.hypotheses:NOTHING",
    "NO_EFFECT": "witnesses.null_space:FLAT",
    "NO_LOSS": "engine.estimator.hypotheses:NONE",
    "PER_AXIS": "engine.estimator.plant:PER_AXIS",
    "PLACES": "engine.estimator.posterior:PLACES",
    "PLANT_STATES": "engine.estimator.estimator_sizes:PLANT_STATES",
    "READY_KNOWN_S": "engine.motion.tick_table:READY_KNOWN_S",
    "READY_S": "engine.motion.tick_table:READY_S",
    "SMALL_WIDTH": "engine.estimator.hypotheses:SMALL_WIDTH",
    "Store": "fleet.store:Store",
    "TAU": "engine.estimator.plant:TAU",
    "TOTAL_SHARE": "engine.estimator.hypotheses:TOTAL_SHARE",
    "TickOutput": "engine.bindings.program:TickOutput",
    "Ticks": "engine.motion.tick_table:Ticks",
    "aerobatic": "witnesses.aerobatic.assess",
    "airborne": "engine.motion.air_spans:airborne",
    "allocation": "engine.motion.allocation",
    "ambiguous_sets": "engine.motion.allocation:ambiguous_sets",
    "any_multirotor": "engine.bindings.plant_rows:any_multirotor",
    "assess": "fleet.assess",
    "attainable": "witnesses.attainable",
    "baselines": "witnesses.healthy.baselines",
    "cut_ticks": "engine.motion.tick_table:cut_ticks",
    "diagnose": "diagnose:diagnose",
    "esc_telemetry": "witnesses.esc.telemetry",
    "estimated": "diagnose:estimated",
    "events": "engine.bindings.event_rows",
    "excitation_response": "witnesses.excitation_response",
    "export_default": "export.export_default",
    "flight_result": "fleet.flight_result",
    "list_hypotheses": "engine.bindings.hypothesis_list:list_hypotheses",
    "noise_covariance": "witnesses.null_space:covariance",
    "null_space": "witnesses.null_space:null_space",
    "observe": "engine.driver:observe",
    "odds": "witnesses.odds",
    "prepare": "diagnose:prepare",
    "prognosis": "fleet.prognosis",
    "program": "engine.bindings.program",
    "rotor_sets": "engine.bindings.event_rows:rotor_sets",
    "saved": "export.projects:saved",
    "usual_gains": "engine.bindings.plant_rows:usual_gains",
    "witness": "witnesses.witness",
}
"""Name -> module, or module:name, below rotorwatch."""

DEFINITIONS = {
    file: f"rotorwatch.engine.estimator.{file}"
    for file in (
        "plant", "noise", "model_error", "kalman", "bank", "hypotheses", "evidence", "announcement", "plausibility", "opposite",
        "posterior",
    )
} | {file: f"rotorwatch.engine.events.{file}" for file in ("decisions", "losses")}  # fmt: skip
"""Files of the default estimator's step, and of the definition that makes losses of its ticks -> their modules."""

__all__ = [
    "AIR",
    "ANNOUNCED_TICKS",
    "ASSESS",
    "DAMPING",
    "DEFINITIONS",
    "ENGINE",
    "GAIN",
    "GROUND",
    "HOVER_LEARN_S",
    "LAG_S",
    "LEARN",
    "LOSS_WIDTH",
    "NOTHING",
    "NO_EFFECT",
    "NO_LOSS",
    "PER_AXIS",
    "PLACES",
    "PLANT_STATES",
    "READY_KNOWN_S",
    "READY_S",
    "SMALL_WIDTH",
    "TAU",
    "TOTAL_SHARE",
    "Case",
    "Conclusion",
    "Estimated",
    "Estimation",
    "ExcitationNoise",
    "Exported",
    "Given",
    "Hypotheses",
    "Store",
    "TickOutput",
    "Ticks",
    "aerobatic",
    "airborne",
    "allocation",
    "ambiguous_sets",
    "any_multirotor",
    "assess",
    "attainable",
    "baselines",
    "cut_ticks",
    "diagnose",
    "esc_telemetry",
    "estimated",
    "events",
    "excitation_response",
    "export_default",
    "flight_result",
    "list_hypotheses",
    "noise_covariance",
    "null_space",
    "observe",
    "odds",
    "prepare",
    "prognosis",
    "program",
    "rotor_sets",
    "saved",
    "usual_gains",
    "witness",
]  # fmt: skip

if TYPE_CHECKING:
    from rotorwatch.answer.conclusion import Conclusion as Conclusion
    from rotorwatch.case.conductor import Case as Case
    from rotorwatch.case.estimated import Estimated as Estimated
    from rotorwatch.diagnose import Estimation as Estimation
    from rotorwatch.diagnose import diagnose as diagnose
    from rotorwatch.diagnose import estimated as estimated
    from rotorwatch.diagnose import prepare as prepare
    from rotorwatch.engine.bindings import event_rows as events
    from rotorwatch.engine.bindings import program as program
    from rotorwatch.engine.bindings.event_rows import rotor_sets as rotor_sets
    from rotorwatch.engine.bindings.hypothesis_list import Hypotheses as Hypotheses
    from rotorwatch.engine.bindings.hypothesis_list import list_hypotheses as list_hypotheses
    from rotorwatch.engine.bindings.plant_rows import any_multirotor as any_multirotor
    from rotorwatch.engine.bindings.plant_rows import usual_gains as usual_gains
    from rotorwatch.engine.bindings.program import TickOutput as TickOutput
    from rotorwatch.engine.definition import ENGINE as ENGINE
    from rotorwatch.engine.driver import observe as observe
    from rotorwatch.engine.estimator.announcement import TICKS as ANNOUNCED_TICKS
    from rotorwatch.engine.estimator.estimator_sizes import PLANT_STATES as PLANT_STATES
    from rotorwatch.engine.estimator.hypotheses import LOSS_WIDTH as LOSS_WIDTH
    from rotorwatch.engine.estimator.hypotheses import NONE as NO_LOSS
    from rotorwatch.engine.estimator.hypotheses import NOTHING as NOTHING
    from rotorwatch.engine.estimator.hypotheses import SMALL_WIDTH as SMALL_WIDTH
    from rotorwatch.engine.estimator.hypotheses import TOTAL_SHARE as TOTAL_SHARE
    from rotorwatch.engine.estimator.plant import AIR as AIR
    from rotorwatch.engine.estimator.plant import DAMPING as DAMPING
    from rotorwatch.engine.estimator.plant import GAIN as GAIN
    from rotorwatch.engine.estimator.plant import PER_AXIS as PER_AXIS
    from rotorwatch.engine.estimator.plant import TAU as TAU
    from rotorwatch.engine.estimator.posterior import PLACES as PLACES
    from rotorwatch.engine.motion import allocation as allocation
    from rotorwatch.engine.motion.air_spans import airborne as airborne
    from rotorwatch.engine.motion.allocation import ambiguous_sets as ambiguous_sets
    from rotorwatch.engine.motion.tick_table import ASSESS as ASSESS
    from rotorwatch.engine.motion.tick_table import GROUND as GROUND
    from rotorwatch.engine.motion.tick_table import HOVER_LEARN_S as HOVER_LEARN_S
    from rotorwatch.engine.motion.tick_table import LAG_S as LAG_S
    from rotorwatch.engine.motion.tick_table import LEARN as LEARN
    from rotorwatch.engine.motion.tick_table import READY_KNOWN_S as READY_KNOWN_S
    from rotorwatch.engine.motion.tick_table import READY_S as READY_S
    from rotorwatch.engine.motion.tick_table import Ticks as Ticks
    from rotorwatch.engine.motion.tick_table import cut_ticks as cut_ticks
    from rotorwatch.export import export_default as export_default
    from rotorwatch.export.projects import Exported as Exported
    from rotorwatch.export.projects import saved as saved
    from rotorwatch.fleet import assess as assess
    from rotorwatch.fleet import flight_result as flight_result
    from rotorwatch.fleet import prognosis as prognosis
    from rotorwatch.fleet.store import Store as Store
    from rotorwatch.witnesses import attainable as attainable
    from rotorwatch.witnesses import excitation_response as excitation_response
    from rotorwatch.witnesses import odds as odds
    from rotorwatch.witnesses import witness as witness
    from rotorwatch.witnesses.aerobatic import assess as aerobatic
    from rotorwatch.witnesses.esc import telemetry as esc_telemetry
    from rotorwatch.witnesses.healthy import baselines as baselines
    from rotorwatch.witnesses.healthy.baselines import Given as Given
    from rotorwatch.witnesses.null_space import FLAT as NO_EFFECT
    from rotorwatch.witnesses.null_space import Noise as ExcitationNoise
    from rotorwatch.witnesses.null_space import covariance as noise_covariance
    from rotorwatch.witnesses.null_space import null_space as null_space


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, member = _PLACES[name].partition(":")
    found = import_module(f"rotorwatch.{module}")
    globals()[name] = found = getattr(found, member) if member else found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
