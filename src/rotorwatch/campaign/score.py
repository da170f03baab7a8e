"""What became of one flight under one method: a row of the campaign's table. `COLUMNS` names and explains all of them.

Healthy time is what was judged before the onset, or the whole flight without a fault. An event in it is a false alarm; after the
onset one that does not name a broken rotor is a wrong one. Losses are compared EVALUATE_S after the onset (or the end of the ramp).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rotorwatch.campaign.plan import Plan
from rotorwatch.default import events
from rotorwatch.default.announcement import TICKS
from rotorwatch.diagnosis import Event
from rotorwatch.experiments import limits
from rotorwatch.motion.ticks import JUDGE
from rotorwatch.simulation.scenario import Scenario

EARLY_S = 0.3  # an event this long before the onset is still the fault's: ticks are windows
EVALUATE_S = 10.0
WINDOWS_S = (1.0, 2.0, 5.0, 10.0)
RISE_S = (
    *(k / 10 for k in range(1, 10)),
    1.0,
    *(k / 10 for k in range(12, 20, 2)),
    2.0,
    2.5,
    3.0,
    3.5,
    4.0,
    4.5,
    5.0,
    6.0,
    7.0,
    8.0,
    9.0,
    10.0,
)
"""Windows in which the largest statistic is kept: from these follows the delay at any threshold."""
NOTHING = -50.0  # statistic where there is none

COLUMNS: dict[str, tuple[str, str]] = {
    "flight": ("int64", "number of the flight: with the plan's seed it says everything"),
    "method": ("string", "estimator or detector"),
    "frame": ("string", "airframe"),
    "autopilot": ("string", "whose log"),
    "profile": ("string", "logging profile"),
    "rotors": ("int64", "how many"),
    "trajectory": ("string", "what was flown"),
    "wind_m_s": ("double", "mean wind 6 m above ground"),
    "fault": ("string", "kind of fault, empty without one"),
    "broken": ("string", "rotors that broke, such as 3 or 2+5"),
    "clear": ("bool", "one rotor, at once: what the bounds are for"),
    "onset_s": ("double", "when it began"),
    "loss": ("double", "true loss of the first broken rotor when losses are compared"),
    "crashed_s": ("double", "when the vehicle lay on the ground, empty if never"),
    "judged_s": ("double", "flight time that was judged"),
    "healthy_s": ("double", "judged before the onset"),
    "false_alarms": ("int64", "events in healthy time"),
    "sure_false_alarms": ("int64", "those of them that name rotors without alternatives: verdict fault, not ambiguous"),
    "wrong": ("int64", "events after the onset that name no broken rotor"),
    "detected": ("bool", "an event after the onset names a broken rotor, alone or among alternatives"),
    "delay_s": ("double", "from the onset to that event"),
    "right": ("bool", "the first event names exactly the broken rotors, without alternatives"),
    "named": ("bool", "the broken rotors are its rotors or one of its alternatives"),
    "estimate": ("double", "loss of the first broken rotor as estimated"),
    "lower": ("double", "its 95 % interval"),
    "upper": ("double", "its 95 % interval"),
    "peak": ("double", "largest lasting statistic in healthy time"),
    **{f"peak_{s:g}s": ("double", f"largest lasting statistic within {s:g} s of the onset") for s in RISE_S},
    "bound_sd": ("double", "posterior Cramer-Rao bound: least standard deviation of the estimate"),
    "bound_delay_s": ("double", "least mean delay at the plan's false-alarm rate"),
}
"""Column -> (type in the Parquet file, what it holds)."""


def clear_fault(scenario: Scenario) -> Mapping[str, Any] | None:
    """The fault of a flight in which one rotor loses thrust at once and for good; else None."""
    if len(scenario.faults) != 1:
        return None
    fault = scenario.faults[0]
    plain = fault["ramp_s"] == 0.0 and fault["period_s"] is None and fault["end_s"] is None
    return fault if plain and fault["kind"] in ("loss", "complete loss", "chipped") else None


def estimator(name: str, f, kept, statistic: np.ndarray, seen: Sequence[Event], bound, plan: Plan) -> dict[str, Any]:
    """The row of an estimator. f: batch.Flown. kept: program.Kept. statistic (T,): above 0 it announces. bound:
    (T,) information of `limits`, or None."""
    found = [(e.detected_s, {tuple(sorted(e.rotors)), *map(tuple, map(sorted, e.alternatives))}, e) for e in seen]
    row = _row(name, f, found, bound, plan)
    if row["fault"]:
        k, rotor = _compared(f), f.scenario.faults[0]["rotor"] - 1
        loss = float(kept.theta[k, rotor])
        sd = float(events.sd_of(kept.theta[k, rotor], kept.theta_sd[k, rotor], f.vehicle.effectiveness()))
        row |= {"estimate": loss, "lower": max(0.0, loss - 1.96 * sd), "upper": min(1.0, loss + 1.96 * sd)}
    row |= _peaks(f, statistic, row["onset_s"])
    return row


def rule(name: str, f, findings: Sequence[Mapping[str, Any]], bound, plan: Plan) -> dict[str, Any]:
    """The row of a detector, which names rotors but no losses. A finding of a rotor counts once."""
    first: dict[int, float] = {}
    for finding in sorted(findings, key=lambda one: one["time_s"]):
        first.setdefault(int(finding["rotor"]), float(finding["time_s"]))
    return _row(name, f, [(t, {(rotor,)}, None) for rotor, t in first.items()], bound, plan)


def _row(name: str, f, found, bound, plan: Plan) -> dict[str, Any]:
    """All columns, empty (None) where they do not apply. found: (detected s, rotor sets, Event or None)."""
    s, ticks = f.scenario, f.ticks
    judged, dt = ticks.mode == JUDGE, ticks.dt
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    onset = min((fault["onset_s"] for fault in s.faults), default=np.inf)
    before = ticks.time < onset
    row |= {
        "flight": f.number, "method": name, "frame": s.airframe["frame"], "autopilot": s.autopilot, "profile": s.logging["profile"],
        "rotors": f.theta.shape[1], "trajectory": s.trajectory["kind"], "wind_m_s": s.wind["speed_m_s"],
        "fault": s.faults[0]["kind"] if s.faults else "", "clear": clear_fault(s) is not None, "crashed_s": f.lost_s,
        "judged_s": float(judged.sum() * dt), "healthy_s": float((judged & before).sum() * dt),
    }  # fmt: skip
    early = [one for one in found if one[0] < onset - EARLY_S]
    later = [one for one in found if one[0] >= onset - EARLY_S]
    sure = sum(len(one[1]) == 1 for one in early)
    row |= {"false_alarms": len(early), "sure_false_alarms": sure, "wrong": 0, "broken": ""}
    if not s.faults:
        return row
    broken = tuple(sorted(fault["rotor"] for fault in s.faults))
    ours = [one for one in later if any(set(who) & set(broken) for who in one[1])]
    row |= {
        "broken": "+".join(map(str, broken)), "onset_s": onset, "loss": float(f.theta[_compared(f), s.faults[0]["rotor"] - 1]),
        "wrong": len(later) - len(ours), "detected": bool(ours), "right": False, "named": False,
    }  # fmt: skip
    if ours:
        when, sets, event = ours[0]
        exact = (tuple(sorted(event.rotors)) if event else next(iter(sets))) == broken
        row |= {
            "delay_s": max(when - onset, 0.0),
            "right": exact and len(sets) == 1 and ours[0] is later[0],
            "named": broken in sets,
        }
    if bound is not None:
        known = float(bound[_compared(f)])
        row["bound_sd"] = float(limits.loss_sd(known)) if known > 0.0 else None
        least = limits.delay(ticks.time, bound, row["loss"], onset, 3600.0 * plan.false_alarm_period_h)
        row["bound_delay_s"] = least if np.isfinite(least) else None
    return row


def _compared(f) -> int:
    """The tick at which losses are compared: EVALUATE_S after the fault is all there, or the last judged one before."""
    fault = f.scenario.faults[0]
    when = fault["onset_s"] + fault["ramp_s"] + EVALUATE_S
    usable = np.flatnonzero((f.ticks.mode == JUDGE) & ~f.ticks.upset & (f.ticks.time <= when))
    return int(usable[-1]) if usable.size else 0


def _peaks(f, statistic: np.ndarray, onset: float | None) -> dict[str, float]:
    """Largest statistic that lasted as long as an announcement needs, in healthy time and in windows after the onset."""
    low = np.where(f.ticks.mode == JUDGE, statistic, NOTHING)
    lasting = low.copy()
    for k in range(1, TICKS):
        lasting[k:] = np.minimum(lasting[k:], low[:-k])
    lasting[: TICKS - 1] = NOTHING
    time, start = f.ticks.time, np.inf if onset is None else onset

    def peak(where):
        return float(max(lasting[where].max(initial=NOTHING), NOTHING))

    found = {"peak": peak(time < start - EARLY_S)}
    if onset is not None:
        found |= {f"peak_{s:g}s": peak((time >= start - EARLY_S) & (time <= start + s)) for s in RISE_S}
    return found
