"""Anyone's labelled flights, diagnosed and scored: what is found, whether the rotor is right, delays, sizes, and false alarms per hour.

    import rotorwatch as rw
    result = rw.evaluate("labels.csv")          # docs/evaluate.md has the columns
    rw.evaluate.write(result, "page.html")      # or .csv, .json

Each flight is diagnosed as by `diagnose`, with its own vehicle file and healthy flights; `counting` defines the outcomes. A fault in a
flight with several is assessed by the events from its onset to the next one's, without the rotors that were broken before and still are.
"""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rotorwatch import logs
from rotorwatch.base import files, many
from rotorwatch.errors import ConfigError, RotorwatchError
from rotorwatch.flight import Flight
from rotorwatch.flight.diagnosis import Diagnosis, Event, RotorState
from rotorwatch.toolkit import diagnose
from rotorwatch_lab.experiments import counting, labels, rival_detector, tools
from rotorwatch_lab.experiments.labels import Fault, Labelled

NAMED = ("right", "extra", "partly", "among")
"""Outcomes in which the answer names a broken rotor."""
WRONG = ("extra", "wrong")
REFUSED = "refused"
OWN = "rotorwatch"  # the detector of an answer's own rows
UNKNOWN = "unknown"  # outcome of a flight of which nobody says whether it is healthy
ROW = (
    "path", "detector", "rotor", "onset_s", "size", "end_s", "label_source", "verdict", "outcome", "found", "accused", "candidates",
    "alarm_s", "delay_s", "onset_error_s", "loss", "low", "high", "size_error", "holds", "false_alarms", "healthy_s", "headline",
    "sentence",
)  # fmt: skip


class _Part(NamedTuple):
    """The part of an answer that concerns one of several faults."""

    verdict: str
    events: Sequence[Event]
    rotors: Sequence[RotorState] = ()


def evaluate(
    flights: str | os.PathLike | Iterable[Mapping[str, Any]],
    jobs: int | None = None,
    progress: Callable[[float, str], Any] | None = None,
    scheduler: str | None = None,
    keep: str | os.PathLike | None = None,
    answered: Callable[[str, Sequence[dict[str, Any]]], Any] | None = None,
    detector: str = "",
) -> dict[str, Any]:
    """Diagnose labelled flights and count what is found.

    flights: a CSV file with the columns of `labels`, or its rows as dicts, with paths relative to the current folder; or a folder.
    detector: another one, run on the same flights and scored beside rotorwatch: FILE.py or a module (`rival_detector`). jobs, scheduler,
    keep: as for `many.in_order`. progress: called as progress(share, text). answered: called as answered(path, rows) for each flight in
    order. The answer:

    flights   a row of ROW for each fault and for each healthy flight, and again for the detector. outcome: of `counting`; refused, with
              the reason in `sentence`; or unknown. alarm_s: the first alarm.
              accused, candidates: rotors; delay_s: from the onset, or from take-off, to the announcement; loss, low, high: the last size
              announced; false_alarms: alarms while no rotor was broken, of healthy_s seconds in the air (in a flight's first row)
    others    the autopilots' own checks on the same flights: detector -> flights (that it alarms in), right and wrong faults, false_alarms
    summary   flights, faults, refused; found, right, wrong, among, missed: shares of the faults answered, `wrong` those with a healthy
              rotor accused; delay_s and onset_error_s: medians; size_rms; holds: share of sizes whose interval contains the label; healthy
              flights with a doubt; healthy_h; false_alarms_h: per hour. Each with its 95 % interval (`tools`), or null
    compared  with a detector: name -> the same summary, of rotorwatch and of the detector

    Raises ConfigError with one sentence for a list that is not one; a log that cannot be diagnosed is a row with the reason.
    """
    if isinstance(flights, str | os.PathLike):
        listed = labels.read(flights)
    else:
        listed = labels.labelled(((f"row {k}", row) for k, row in enumerate(flights, start=1)), "The list", Path())
    if detector:
        rival_detector.load(detector)
        listed = [flight._replace(detector=detector) for flight in listed]
    report = progress or (lambda share, text="": None)
    rows: list[dict[str, Any]] = []
    findings: list[tuple[Labelled, list[dict[str, Any]], float]] = []
    done = many.in_order(_assessed, listed, jobs, scheduler, lambda n: report(n / len(listed), "diagnosing"), keep)
    for flight, answer in zip(listed, done, strict=True):
        if answer.error is not None and not isinstance(answer.error, RotorwatchError):
            raise answer.error
        found, others = answer.value if answer.error is None else (_refused(flight, str(answer.error)), [])
        rows += found
        if found[0]["outcome"] != REFUSED:
            findings.append((flight, others, float(found[0]["healthy_s"])))
        if answered:
            answered(flight.name, found)
    own = [row for row in rows if row["detector"] == OWN]
    names = dict.fromkeys(row["detector"] for row in rows)
    compared = {name: summarise([row for row in rows if row["detector"] == name]) for name in names} if detector else {}
    return {"flights": rows, "others": _others(findings), "summary": summarise(own), **({"compared": compared} if detector else {})}


def _assessed(flight: Labelled) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """(rows, findings of the autopilots' checks) of a flight."""
    try:
        if not any(map(os.path.exists, (flight.path, flight.path.rpartition("#")[0]))):  # FILE#2: a session of it
            raise ConfigError(f"{flight.path}: no such file.")
        log = logs.read(flight.path) if flight.detector else flight.path
        answer = diagnose(log, flight.vehicle, flight.baseline)
        rotors = len(answer.rotors) or int(answer.flight["rotors"])
        if beyond := [r for fault in flight.faults for r in fault.rotors if r > rotors]:
            raise ConfigError(f"{flight.path}: the list names rotor {beyond[0]} of a vehicle with {rotors}.")
        own = scored(flight, answer)
        if isinstance(log, Flight):
            other = rival_detector.answer(flight.detector, log, flight.vehicle, answer)
            own += [row | {"detector": other.estimator} for row in scored(flight, other)]
    except RotorwatchError as why:
        return _refused(flight, str(why)), []
    return own, [dict(finding) for finding in answer.comparison]


def _refused(flight: Labelled, sentence: str) -> list[dict[str, Any]]:
    known = _known(flight, flight.faults[0] if flight.faults else None)
    return [known | {"outcome": REFUSED, "sentence": sentence, "false_alarms": 0, "healthy_s": 0.0}]


def _known(flight: Labelled, fault: Fault | None) -> dict[str, Any]:
    row: dict[str, Any] = dict.fromkeys(ROW) | {"path": flight.name, "detector": OWN, "label_source": flight.label_source, "rotor": ""}
    if fault is not None:
        row |= {"rotor": "+".join(map(str, fault.rotors)), "onset_s": fault.onset_s, "size": fault.size, "end_s": fault.end_s}
    return row


def scored(flight: Labelled, answer: Diagnosis) -> list[dict[str, Any]]:
    """The rows of a flight with this answer."""
    air = [(float(a), float(b)) for a, b in answer.flight.get("hops") or ()]
    broken = [(f.onset_s, np.inf if f.end_s is None else f.end_s) for f in flight.faults]
    healthy_s = sum(b - a for a, b in air) - _overlap(air, broken)
    raised = counting.alarms(answer.events)
    said = {"verdict": answer.verdict, "headline": answer.headline, "alarm_s": raised[0].detected_s if raised else None}
    if not flight.known:
        return [_known(flight, None) | said | _names(answer) | {"outcome": UNKNOWN, "false_alarms": 0, "healthy_s": 0.0}]
    if not flight.faults:
        outcome = counting.outcome(answer)
        false = len(raised) or int(outcome == "accused")  # a fault from take-off is in no event
        return [_known(flight, None) | said | _names(answer) | {"outcome": outcome, "false_alarms": false, "healthy_s": healthy_s}]
    rows = []
    for k, fault in enumerate(flight.faults):
        start = -np.inf if k == 0 else fault.onset_s - counting.EARLY_S
        end = flight.faults[k + 1].onset_s - counting.EARLY_S if k + 1 < len(flight.faults) else np.inf
        part = _Part(answer.verdict, answer.events, answer.rotors)
        if len(flight.faults) > 1:
            still = {r for f in flight.faults[:k] if f.end_s is None or f.end_s > fault.onset_s for r in f.rotors} - {*fault.rotors}
            events = tuple(_without(e, still) for e in answer.events if start <= e.detected_s < end)
            doubt = any(e.alternatives and e.means.accuses for e in events)
            part = _Part("ambiguous" if doubt else "healthy", events)
        own = _row(fault, part, counting.alarms(e for e in part.events if start <= e.detected_s < end), air)
        rows.append(_known(flight, fault) | said | _names(part) | own | {"healthy_s": healthy_s if k == 0 else 0.0})
    return rows


def _without(event: Event, rotors: set[int]) -> Event:
    """The event without these rotors."""
    if not rotors & event.suspects:
        return event
    kept = [k for k, rotor in enumerate(event.rotors) if rotor not in rotors]
    named = tuple(event.rotors[k] for k in kept)
    left = (tuple(r for r in other if r not in rotors) for other in event.alternatives)
    sizes = {"loss": tuple(event.loss[k] for k in kept), "interval": tuple(event.interval[k] for k in kept)} if event.loss else {}
    return replace(event, rotors=named, alternatives=tuple(a for a in left if a and a != named), **sizes)


def _row(fault: Fault, answer: Any, raised: Sequence[counting.Alarm], air: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """The scores of one fault. raised: the alarms of its part of the flight."""
    from_takeoff = bool(air) and fault.onset_s <= air[0][0]
    began = air[0][0] if from_takeoff else fault.onset_s
    over_s = np.inf if fault.end_s is None else fault.end_s + counting.EARLY_S
    inside = [a for a in raised if a.event is None or a.event.onset_s <= over_s]
    onset = 0.0 if from_takeoff else fault.onset_s
    counted, outcome = counting.count(inside, fault.rotors, onset), counting.outcome(answer, fault.rotors, onset)
    row: dict[str, Any] = {
        "outcome": outcome, "found": counted.found or outcome in NAMED, "false_alarms": len(counted.false) + len(raised) - len(inside),
    }  # fmt: skip
    if counted.found:
        first = counted.own[0]
        row["delay_s"] = max(first.detected_s - began, 0.0)
        if first.event is not None and not from_takeoff:
            row["onset_error_s"] = first.event.onset_s - fault.onset_s
    if size := _size(fault, answer, [a.event for a in counted.own if a.event is not None]):
        row |= dict(zip(("loss", "low", "high"), size))
        if fault.size is not None:
            row |= {"size_error": size[0] - fault.size, "holds": counting.holds(size[1], size[2], fault.size)}
    return row


def _size(fault: Fault, answer: Any, own: Sequence[Event]) -> tuple[float, float, float] | None:
    """(loss, low, high) of a broken rotor: of its last event, else as the answer has it from take-off."""
    if found := counting.sized(fault.rotors, own):
        return found[1:]
    damaged = (r for r in answer.rotors if r.rotor in fault.rotors and r.from_takeoff == "damaged")
    return next(((r.loss, *r.interval) for r in damaged), None)


def _names(answer: Any) -> dict[str, str]:
    return {
        what: "+".join(map(str, sorted(of(answer)))) for what, of in (("accused", counting.accused), ("candidates", counting.candidates))
    }


def _overlap(air: Iterable[tuple[float, float]], spans: Sequence[tuple[float, float]]) -> float:
    """Seconds of `air` within any of `spans`, which may overlap, in order of their beginnings."""
    total, last = 0.0, -np.inf
    for start, end in spans:
        start = max(start, last)
        total += sum(max(0.0, min(b, end) - max(a, start)) for a, b in air)
        last = max(last, end)
    return total


def _others(findings: Sequence[tuple[Labelled, list[dict[str, Any]], float]]) -> dict[str, dict[str, Any]]:
    """The scores of the autopilots' own checks, by detector."""
    found: dict[str, dict[str, Any]] = {}
    for flight, all_of_it, _ in findings:
        for name in sorted({f["detector"] for f in all_of_it}):
            raised = [counting.Alarm(f["time_s"], ((f["rotor"],),)) for f in all_of_it if f["detector"] == name]
            first = flight.faults[0] if flight.faults else Fault((), np.inf)
            counted = counting.count(raised, first.rotors, first.onset_s)
            row = found.setdefault(name, {"flights": 0, "right": 0, "wrong": 0, "false_alarms": 0})
            row["flights"] += 1
            row["right"] += counted.right
            row["wrong"] += bool(counted.wrong)
            row["false_alarms"] += len(counted.false)
    return found


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The summary of `evaluate`, also of some of its rows."""
    answered = [r for r in rows if r["outcome"] not in (REFUSED, UNKNOWN)]
    faults = [r for r in answered if r["rotor"]]
    healthy = [r for r in answered if not r["rotor"]]
    errors = [r["size_error"] for r in faults if r["size_error"] is not None]
    hours = sum(r["healthy_s"] for r in answered) / 3600.0

    def share(*outcomes: str) -> dict[str, float] | None:
        return tools.share([r["outcome"] in outcomes for r in faults])

    return {
        "flights": len({r["path"] for r in rows}), "faults": len(faults), "healthy": len(healthy), 
        "refused": sum(r["outcome"] == REFUSED for r in rows),
        "found": tools.share([r["found"] for r in faults]), "right": share("right"), "wrong": share(*WRONG),
        "among": share("among", "partly"), "missed": share("missed", "astray"),
        "delay_s": tools.boot([r["delay_s"] for r in faults if r["delay_s"] is not None], np.median),
        "onset_error_s": tools.boot([abs(r["onset_error_s"]) for r in faults if r["onset_error_s"] is not None], np.median),
        "size_rms": tools.boot(errors, lambda e: np.sqrt(np.mean(np.square(e)))),
        "holds": tools.share([r["holds"] for r in faults if r["holds"] is not None]),
        "doubts": tools.share([r["outcome"] == "doubt" for r in healthy]), "healthy_h": hours,
        "false_alarms_h": tools.rate(sum(r["false_alarms"] for r in answered), hours),
    }  # fmt: skip


def lines(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(what, text) of a summary, for people."""
    rate, of = summary["false_alarms_h"], tools.interval
    shares = {"found": "found", "right": "right rotor", "wrong": "healthy rotor accused", "among": "among candidates", "missed": "missed"}
    return [
        ("flights", f"{summary['flights']}, {summary['refused']} refused"),
        ("faults", str(summary["faults"])),
        *((text, of(summary[key])) for key, text in shares.items()),
        ("delay, median", of(summary["delay_s"], 2) + " s"),
        ("onset error, median", of(summary["onset_error_s"], 2) + " s"),
        ("size error, rms", of(summary["size_rms"], 3)),
        ("intervals that hold", of(summary["holds"])),
        ("healthy flight", f"{summary['healthy_h']:.2f} h; flights without a fault: {summary['healthy']}"),
        ("healthy but ambiguous", of(summary["doubts"])),
        ("false alarms an hour", "-" if rate is None else f"{of(rate, 2)}, {rate['n']} in all"),
    ]


def first(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """(what, text): on how many flights which of two detectors alarmed first, and by how much."""
    times: dict[str, dict[str, float | None]] = {}
    for row in rows:
        if row["outcome"] != REFUSED:
            times.setdefault(row["path"], {}).setdefault(row["detector"], row["alarm_s"])
    pairs = [tuple(one.values()) for one in times.values() if len(one) == 2]
    both = [b - a for a, b in pairs if a is not None and b is not None]
    alone = [sum(a is not None and b is None for a, b in pairs), sum(a is None and b is not None for a, b in pairs)]
    ahead = float(np.median(both)) if both else 0.0
    lead = f", {OWN} {abs(ahead):.2f} s {'earlier' if ahead >= 0.0 else 'later'} (median)" if both else ""
    return [("alarms", f"both on {len(both)} of {len(pairs)} flights{lead}; only {OWN} on {alone[0]}, only the other on {alone[1]}")]


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as CSV text."""
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(ROW)
    out.writerows([f"{v:.4f}" if isinstance(v := row[key], float) else "" if v is None else v for key in ROW] for row in rows)
    return text.getvalue()


SUFFIXES = (".html", ".csv", ".json")


def writable(path: str | os.PathLike) -> Path:
    """Check a file to write before the work. Raises ConfigError."""
    target = files.writable(path, "--out")
    if target.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"--out {path}: give a name that ends in .html, .csv or .json.")
    return target


def write(result: Mapping[str, Any], path: str | os.PathLike) -> None:
    """Write the answer of `evaluate`: a page (.html), its flights (.csv), or all of it (.json). Raises ConfigError."""
    target = writable(path)
    if target.suffix.lower() == ".html":
        from rotorwatch_lab.experiments import evaluation_page

        own = [row for row in result["flights"] if row["detector"] == OWN]
        text = evaluation_page.page({**result, "flights": own}, lines(result["summary"]))
    else:
        text = table(result["flights"]) if target.suffix.lower() == ".csv" else json.dumps(result, indent=1, allow_nan=False)
    with files.replacing(target) as unfinished:
        Path(unfinished).write_text(text, encoding="utf-8")
