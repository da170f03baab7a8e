"""Diagnosis, log and vehicle as short answers: plain data in the types of models.py, of bounded size for a conversation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rotorwatch import report
from rotorwatch.assistants.quoted import label, quoted, several, utc
from rotorwatch.base.files import one_line
from rotorwatch.flight.diagnosis import Diagnosis
from rotorwatch.report.info import MESSAGES_SHOWN

MOST_EVENTS, MOST_ADVICE, MOST_STORY, MOST_WARNINGS, MOST_MESSAGES, MOST_SIGNALS, MOST_GAPS = 6, 3, 5, 3, 8, 30, 9
SENTENCE = 600  # letters of a sentence
LIST = 12  # entries of a list in the details of an event
SHORT = ("kind", "rotors", "alternatives", "onset_s", "detected_s", "end_s", "loss", "interval", "probability")


def cut(text: str, most: int = SENTENCE) -> str:
    """A sentence of rotorwatch's own, cut to that length."""
    return text if len(text) <= most else one_line(text, most)


def diagnosis(found: Diagnosis, name: str) -> dict[str, Any]:
    """`Diagnosis` of models.py. name: the log's own name."""
    d = found.to_dict()
    flight = d["flight"]
    left = len(d["events"]) - MOST_EVENTS
    return {
        "log": quoted(name),
        "firmware": quoted(flight.get("firmware") or "", 80),
        "flight": {
            "format": label(str(flight["format"]).lower().replace(" ", "-")),
            "frame": label(flight["frame"]),
            "rotors": flight["rotors"],
            "duration_s": round(flight["duration_s"], 1),
            "airborne_s": [round(t, 1) for t in flight["airborne_s"]],
            "utc_start": utc(flight.get("utc_start")),
        },
        "verdict": d["verdict"],
        "exit_code": found.exit_code,
        "headline": cut(d["headline"]),
        "reason": cut(d["reason"]),
        "story": [cut(line["text"], 300) for line in d["story"][:MOST_STORY]],
        "main_event": d["main_event"],
        "events": [_line(k, d["events"][k]) for k in found.important(MOST_EVENTS)],
        "rotors": [_rotor(r) for r in d["rotors"]],
        "advice": [cut(a, 300) for a in d["advice"][:MOST_ADVICE]],
        "warnings": several(d["warnings"], MOST_WARNINGS, 120),
        "note": f"{left} more events; `event` shows one by its number." if left > 0 else None,
    }


def _line(number: int, event: Mapping) -> dict[str, Any]:
    row: dict[str, Any] = {"number": number} | {name: event[name] for name in SHORT}
    row["alternatives"] = row["alternatives"][:LIST]
    return row | {name: event[name] for name in ("cause", "count") if event.get(name) is not None}


def _rotor(r: Mapping) -> dict[str, Any]:
    row = {name: r[name] for name in ("rotor", "place", "status", "loss", "interval")}
    optional = {"since_takeoff": r["since_takeoff"], "grade": None if r["grade"] == "not assessed" else r["grade"]}
    return row | {name: value for name, value in (optional | {"note": cut(r["note"], 120)}).items() if value}


def compared(found: Diagnosis, name: str, healthy: Sequence[str]) -> dict[str, Any]:
    """`Compared` of models.py. healthy: names of the healthy flights; in sentences they are healthy-1, healthy-2 .."""
    whole = found.to_dict()["whole_flight"]
    if whole:
        whole = {k: v for k, v in whole.items() if k not in ("shift", "shift_sd")}
        whole["causes"] = (whole.get("causes") or [])[:MOST_EVENTS]
        whole["reason"] = cut(whole["reason"])
    return diagnosis(found, name) | {"healthy_flights": [quoted(h, 80) for h in healthy], "whole_flight": whole}


def event(found: Diagnosis, name: str, number: int | None) -> dict[str, Any] | str:
    """`Event` of models.py, by default the main one; a sentence where there is no such event."""
    d = found.to_dict()
    many = len(d["events"])
    if number is None:
        number = d["main_event"] if d["main_event"] is not None else 0
    if not 0 <= number < many:
        last = many - 1
        return f"number: this diagnosis has the events 0 to {last}." if many else "This diagnosis has no event."
    one = d["events"][number]
    details = {k: _short(v) for k, v in one.items() if k not in (*SHORT, "reason", "evidence", "count")}
    return {
        "log": quoted(name),
        "number": number,
        "of": many,
        "event": _line(number, one),
        "reason": cut(one["reason"]),
        "evidence": [cut(e) for e in one.get("evidence", ())][:LIST],
        "details": details,
        "other_checks": [
            {"detector": c["detector"], "rotor": c.get("rotor"), "time_s": c["time_s"], "reason": quoted(c["reason"], 120)}
            for c in d["comparison"][:MOST_EVENTS]
        ],
    }  # fmt: skip


def _short(value: Any) -> Any:
    if isinstance(value, list):
        return [_short(v) for v in value[:LIST]]
    if isinstance(value, dict):
        return {k: _short(v) for k, v in value.items()}
    return cut(value) if isinstance(value, str) else value


def log(facts: Mapping[str, Any], name: str) -> dict[str, Any]:
    """`Log` of models.py. facts: as `report.info.info` gives them."""
    messages = sorted(facts["messages"], key=lambda m: (m["kind"] not in ("error", "text"), m["time_s"]))
    latest = sorted(messages[:MOST_MESSAGES], key=lambda m: m["time_s"])
    signals = [s for s in facts["signals"] if label(s["name"])][:MOST_SIGNALS]
    return {
        "log": quoted(name),
        "firmware": quoted(facts["firmware"], 80),
        "vehicle_type": quoted(facts["vehicle_type"], 80),
        "format": label(str(facts["format"]).lower().replace(" ", "-")),
        "frame": label(facts["frame"]),
        "rotors": facts["rotors"],
        "duration_s": facts["duration_s"],
        "airborne_s": facts["airborne_s"][:LIST],
        "ready": facts["ready"],
        "signals": [{name: s[name] for name in ("name", "rate_hz", "valid")} for s in signals],
        "missing": [gap["signal"] for gap in facts["missing"] if not gap["present"]],
        "slow": [gap["signal"] for gap in facts["missing"] if gap["present"]],
        "parameters": facts["parameters"],
        "messages": [{"time_s": m["time_s"], "kind": m["kind"], "text": quoted(m["text"], 80)} for m in latest],
        "messages_left_out": len(facts["messages"]) - len(latest),
        "warnings": several(facts["warnings"], MOST_WARNINGS),
        "note": None if len(facts["messages"]) < MESSAGES_SHOWN else f"Only the first {MESSAGES_SHOWN} messages are used.",
    }  # fmt: skip


def what_to_log(facts: Mapping[str, Any], name: str) -> dict[str, Any]:
    """`WhatToLog` of models.py. facts: as `report.info.info` gives them."""
    missing = [gap | {"why": cut(gap["why"]), "setting": cut(gap["setting"])} for gap in facts["missing"][:MOST_GAPS]]
    advice = [] if missing else ["Nothing is missing: this log has everything a diagnosis uses."]
    return {"log": quoted(name), "ready": facts["ready"], "missing": missing, "advice": advice}


MOST_CASES = 24


def survival(found: Any, name: str, verdicts: Sequence[str]) -> dict[str, Any]:
    """`Survival` of models.py, of what `rotorwatch.survive` found: cases with the same result share a row. verdicts: in their order."""
    groups: dict[tuple, list[list[int]]] = {}
    for case in found.cases:
        wind = None if case.wind is None else round(case.wind)
        groups.setdefault((len(case.rotors), case.loss, case.verdict, round(case.lift, 2), wind), []).append(list(case.rotors))
    order = sorted(groups, key=lambda g: (g[0], g[1], verdicts.index(g[2]), -g[3]))
    rows = [{"rotors": groups[g], "loss": g[1], "then": g[2], "lift": g[3], "wind": g[4]} for g in order[:MOST_CASES]]
    left = len(order) - len(rows)
    return {
        "vehicle": quoted(name),
        "rotors": found.rotors,
        "mass_kg": round(float(found.airframe.mass), 3),
        "thrust_to_weight": round(found.healthy.lift, 2),
        "summary": found.summary,
        "cases": rows,
        "assumptions": [cut(a) for a in found.assumptions],
        "note": f"{left} more groups of cases; ask for one loss at a time." if left else None,
    }


def caption(found: Diagnosis, kind: str) -> str:
    """The content of a plot, in a sentence."""
    if kind == "flight":
        return "The loss of every rotor with its 95 % band, and the commands, over the whole flight."
    facts: Any = found.picture
    marks = ", ".join(f"{m['what']} at {report.seconds(m['time_s'])}" for m in facts["marks"])
    return f"Setpoint, actual motion and the commands of every rotor from {facts['start_s']:.1f} to {facts['end_s']:.1f} s: {marks}."
