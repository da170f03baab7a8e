"""Scores one flight under one method: a row of the campaign's table, with the columns `COLUMNS`.

Healthy time is the evaluated time before the onset, or of the whole flight without a fault. counting.py defines found, right and false
alarm. Losses are compared EVALUATE_S after the onset (or the end of the ramp).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rotorwatch.base import files
from rotorwatch.toolkit import ANNOUNCED_TICKS as TICKS
from rotorwatch.toolkit import ASSESS, Conclusion, events
from rotorwatch_lab.campaign.plan import Plan
from rotorwatch_lab.experiments import counting, limits
from rotorwatch_lab.experiments.counting import EARLY_S, Alarm
from rotorwatch_lab.simulation import prepare
from rotorwatch_lab.simulation.scenario import Scenario

EVALUATE_S = 10.0
WINDOWS_S = (1.0, 2.0, 5.0, 10.0)
RISE_S = (
    *(k / 10 for k in range(1, 10)), *(k / 10 for k in range(10, 20, 2)), *(k / 2 for k in range(4, 10)), *map(float, range(5, 11)),
)  # fmt: skip
"""Windows in which the largest statistic is kept: from these follows the delay at any threshold."""
# Statistic where there is none, and of an announcement without one, whatever the threshold.
NOTHING, CERTAIN = -50.0, 50.0


def read_columns(table: str) -> dict[str, tuple[str, str]]:
    """Column -> (type in the Parquet file, what it holds), of a table of columns.toml."""
    known, _ = files.toml(Path(__file__).with_name("columns.toml"), "table of columns")
    return {name: (kind, about) for name, (kind, about) in known[table].items()}


COLUMNS: dict[str, tuple[str, str]] = {
    **read_columns("flight"),
    **{f"peak_{s:g}s": ("double", f"largest lasting statistic within {s:g} s of the onset") for s in RISE_S},
    **read_columns("bound"),
}
"""Column -> (type in the Parquet file, what it holds)."""


def clear_fault(scenario: Scenario) -> Mapping[str, Any] | None:
    """The fault of a flight in which one rotor loses thrust at once and for good; else None."""
    if len(scenario.faults) != 1:
        return None
    fault = scenario.faults[0]
    plain = fault["ramp_s"] == 0.0 and fault["period_s"] is None and fault["end_s"] is None
    return fault if plain and fault["kind"] in ("loss", "complete loss", "chipped") else None


def estimator(
    name: str, f, out, statistic: np.ndarray, raised: Sequence[Alarm], bound, plan: Plan, certain: Sequence[float] = ()
) -> dict[str, Any]:
    """The row of an estimator. f: batch.Flown. out: program.TickOutput. statistic (T,): above 0 it announces. bound:
    (T,) information of `limits`, or None. certain: when something was announced without the statistic [s]."""
    row = _row(name, f, raised, bound, plan)
    if row["fault"]:
        k, rotor = _compared(f), f.scenario.faults[0]["rotor"] - 1
        loss = float(out.theta[k, rotor])
        sd = float(events.sd_of(out.theta[k, rotor], out.theta_sd[k, rotor], f.vehicle.effectiveness()))
        row |= {"estimate": loss, "lower": max(0.0, loss - 1.96 * sd), "upper": min(1.0, loss + 1.96 * sd)}
    row |= _peaks(f, statistic, row["onset_s"], certain)
    return row


def answer(end: Conclusion) -> dict[str, str]:
    """Columns of the answer of `diagnose` to the whole flight."""
    named = () if end.main is None else end.events[end.main].explanations
    accused = {state.rotor for state in end.rotors if state.status not in ("healthy", "unobservable")}.union(*named)
    return {"answer": end.verdict, "accused": "+".join(map(str, sorted(accused)))}


def rule(name: str, f, findings: Sequence[Mapping[str, Any]], bound, plan: Plan) -> dict[str, Any]:
    """The row of a detector, which names rotors but no losses. A finding of a rotor counts once."""
    first: dict[int, float] = {}
    for finding in sorted(findings, key=lambda one: one["time_s"]):
        first.setdefault(int(finding["rotor"]), float(finding["time_s"]))
    return _row(name, f, [Alarm(t, ((rotor,),)) for rotor, t in first.items()], bound, plan)


def _row(name: str, f, raised: Sequence[Alarm], bound, plan: Plan) -> dict[str, Any]:
    """All columns, empty (None) where they do not apply."""
    s, ticks = f.scenario, f.ticks
    assessing, dt = ticks.mode == ASSESS, ticks.dt
    row: dict[str, Any] = dict.fromkeys(COLUMNS)
    onset = min((fault["onset_s"] for fault in s.faults), default=np.inf)
    before = ticks.time < onset
    row |= {
        "flight": f.number, "method": name, "frame": s.airframe["frame"], "autopilot": s.autopilot, "profile": s.logging["profile"],
        "rotors": f.theta.shape[1], "trajectory": s.trajectory["kind"], "wind_m_s": s.wind["speed_m_s"],
        "induced_m_s": prepare.induced_velocity(s) if isinstance(s, Scenario) else None,
        "fault": s.faults[0]["kind"] if s.faults else "", "clear": clear_fault(s) is not None, "crashed_s": f.lost_s,
        "assessed_s": float(assessing.sum() * dt), "healthy_s": float((assessing & before).sum() * dt),
    }  # fmt: skip
    broken = tuple(sorted(fault["rotor"] for fault in s.faults))
    counted = counting.count(raised, broken, onset)
    row |= {
        "false_alarms": len(counted.false), "sure_false_alarms": sum(len(a.sets) == 1 for a in counted.false), "wrong": 0, "broken": "",
    }  # fmt: skip
    if not s.faults:
        return row
    row |= {
        "broken": "+".join(map(str, broken)), "onset_s": onset, "loss": float(f.theta[_compared(f), s.faults[0]["rotor"] - 1]),
        "wrong": len(counted.wrong), "detected": counted.found, "right": counted.right, "named": counted.named, "delay_s": counted.delay_s,
    }  # fmt: skip
    if bound is not None:
        known = float(bound[_compared(f)])
        row["bound_sd"] = float(limits.loss_sd(known)) if known > 0.0 else None
        least = limits.delay(ticks.time, bound, row["loss"], onset, 3600.0 * plan.false_alarm_period_h)
        row["bound_delay_s"] = least if np.isfinite(least) else None
    return row


def _compared(f) -> int:
    """The tick at which losses are compared: EVALUATE_S after the fault is fully developed, or the last evaluated one before."""
    fault = f.scenario.faults[0]
    when = fault["onset_s"] + fault["ramp_s"] + EVALUATE_S
    usable = np.flatnonzero((f.ticks.mode == ASSESS) & ~f.ticks.upset & (f.ticks.time <= when))
    return int(usable[-1]) if usable.size else 0


def _peaks(f, statistic: np.ndarray, onset: float | None, certain: Sequence[float] = ()) -> dict[str, float]:
    """Largest statistic that lasted as long as an announcement needs, in healthy time and in windows after the onset. certain (K,): when
    it is CERTAIN."""
    low = np.where(f.ticks.mode == ASSESS, statistic, NOTHING)
    lasting = low.copy()
    for k in range(1, TICKS):
        lasting[k:] = np.minimum(lasting[k:], low[:-k])
    lasting[: TICKS - 1] = NOTHING
    time, start = np.append(f.ticks.time, np.array(certain, float)), np.inf if onset is None else onset
    lasting = np.append(lasting, np.full(len(certain), CERTAIN))

    def peak(where):
        return float(max(lasting[where].max(initial=NOTHING), NOTHING))

    peaks = {"peak": peak(time < start - EARLY_S)}
    if onset is not None:
        peaks |= {f"peak_{s:g}s": peak((time >= start - EARLY_S) & (time <= start + s)) for s in RISE_S}
    return peaks
