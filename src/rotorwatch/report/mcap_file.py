"""A diagnosis as an MCAP file, for Foxglove and PlotJuggler next to the log: JSON messages with their schemas, one a tick.

    /rotorwatch/losses     rotor_1.loss, .lower, .upper ..     shares of the rotor's thrust, 95 % interval
    /rotorwatch/evidence   rotor_1, best_pair .., threshold    log10 odds against healthy, and the threshold of an announcement
    /rotorwatch/residuals  roll, pitch, yaw, thrust, and their standard deviations (roll_sd ..), hover thrusts of one rotor
    /rotorwatch/motors     rotor_1 ..                          commands, shares of full thrust
    /rotorwatch/attitude   roll, pitch, yaw, and wanted_roll ..  degrees
    /rotorwatch/rates      roll, pitch, yaw, and wanted_roll ..  degrees/s, of a vehicle that is flown by rates
    /rotorwatch/state      phase                               on the ground, assessed, or why not; at every change
    /rotorwatch/events     moment (onset, announced, end) and the fields of docs/json.md
    /rotorwatch/verdict    the answer, once, at the start
    /rotorwatch/log        foxglove.Log: the autopilot's messages and modes, the events, the verdict

Unknown values are left out. MCAP: https://mcap.dev/spec; foxglove.Log: https://docs.foxglove.dev/docs/sdk/schemas/log
"""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Iterator, Mapping
from datetime import datetime
from itertools import groupby
from typing import Any

import numpy as np

from rotorwatch import __version__, report
from rotorwatch.base import files, optional
from rotorwatch.flight.diagnosis import Diagnosis, Trace

AXES, BAND = ("roll", "pitch", "yaw", "thrust"), ("loss", "lower", "upper")
ANGLES = AXES[:3]
NAME = "rotorwatch"
LOG, INFO, WARNING, ERROR = f"/{NAME}/log", 2, 3, 4  # foxglove.Log's levels
ON_GROUND, ASSESSED = "on the ground", "assessed"
CLOCKS = {"utc": "UTC", "boot": "time since the autopilot's start", "log": "time since the log's first record"}
Row = tuple[float, str, str]
"""Time s of the log, topic, JSON."""


def write(diagnosis: Diagnosis, path: str | os.PathLike) -> None:
    """Write the diagnosis to `path` atomically. Raises ConfigError when it cannot be written, or the package mcap is missing.

    Times are the log's: UTC where the log says it, else since the autopilot's start, else since the first record.
    """
    target = files.writable(path, "The MCAP file")
    whole = content(diagnosis)
    with files.replacing(target) as temporary:
        temporary.write_bytes(whole)


def content(diagnosis: Diagnosis) -> bytes:
    """The MCAP file as bytes."""
    writer_of = optional.library("mcap.writer", "Writing an MCAP file")
    clock, start_ns = _clock(diagnosis)
    file = io.BytesIO()
    writer = writer_of.Writer(file)
    writer.start(profile="", library=f"{NAME} {__version__}")
    channels: dict[str, int] = {}
    series = {} if diagnosis.trace is None else _series(diagnosis.trace)
    for time, topic, text in sorted(_rows(diagnosis), key=lambda row: row[0]):
        if topic not in channels:
            schema = _schema(topic, text, series[topic][0] if topic in series else None)
            number = writer.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
            channels[topic] = writer.register_channel(topic, "json", number)
        stamp = max(0, start_ns + round(time * 1e9))
        if topic == LOG:
            seconds, nanos = divmod(stamp, 10**9)
            text = f'{{"timestamp":{{"sec":{seconds},"nsec":{nanos}}},{text[1:]}'
        writer.add_message(channels[topic], stamp, text.encode(), stamp)
    answer = diagnosis.to_json().encode()
    writer.add_attachment(start_ns, start_ns, "diagnosis.json", "application/json", answer)
    about = {"log": str(diagnosis.flight.get("name") or ""), "verdict": diagnosis.verdict}
    writer.add_metadata(NAME, about | {"headline": diagnosis.headline or "", "clock": CLOCKS[clock]})
    writer.finish()
    return file.getvalue()


def _clock(diagnosis: Diagnosis) -> tuple[str, int]:
    """(which clock, ns on it of second 0 of the log)."""
    start, boot = diagnosis.flight.get("utc_start"), diagnosis.flight.get("boot_s")
    if start:
        moment = datetime.fromisoformat(str(start).replace("Z", "+00:00"))
        return "utc", round(moment.timestamp() * 1000) * 1_000_000
    return ("boot", round(boot * 1e9)) if boot else ("log", 0)


def key(name: str) -> str:
    """Field name of a message: `rotor 1` is rotor_1."""
    return re.sub(r"\W+", "_", name)


def _rows(diagnosis: Diagnosis) -> Iterator[Row]:
    trace = diagnosis.trace
    first = float(trace.time[0]) if trace is not None and trace.time.size else 0.0
    shown = ("verdict", "headline", "reason", "advice", "rotors", "warnings")
    yield _message("verdict", first, {k: v for k, v in diagnosis.to_dict().items() if k in shown})
    yield _log(first, WARNING if diagnosis.exit_code else INFO, NAME, diagnosis.headline or diagnosis.reason)
    for event in diagnosis.events:
        about = event.to_dict()
        for moment, time in (("onset", event.onset_s), ("announced", event.detected_s), ("end", event.end_s)):
            if time is not None and np.isfinite(time):
                yield _message("events", time, {"moment": moment, **about})
        title = " ".join((event.means.noun, report.who(event, diagnosis), report.losses(event))).strip()
        yield _log(event.detected_s, ERROR, NAME, f"{title}: {event.reason}" if event.reason else title)
    if trace is not None:
        yield from _ticks(trace)
        yield from _phases(trace)
        for time, kind, text in trace.messages:
            yield _log(time, ERROR if kind == "error" else INFO, "autopilot", f"{kind}: {text}")


def _message(topic: str, time: float, fields: Mapping[str, Any]) -> Row:
    return float(time), f"/{NAME}/{topic}", json.dumps({"time_s": time, **fields}, allow_nan=False)


def _log(time: float, level: int, name: str, message: str) -> Row:
    return float(time), LOG, json.dumps({"level": level, "message": message, "name": name, "file": "", "line": 0})


def _series(trace: Trace) -> dict[str, tuple[list[str], np.ndarray]]:
    """Topic -> names (k,) and values (T, k) on every tick; a name with a dot is in an object of its own."""
    rotors = [f"rotor_{k + 1}" for k in range(trace.loss.shape[1])]
    evidence = [key(name) for name in trace.evidence]
    odds = np.stack([*trace.evidence.values()], axis=1) if evidence else np.zeros((trace.time.size, 0))
    found = {
        "evidence": ([*evidence, "threshold"], np.column_stack([odds, np.full(trace.time.size, trace.threshold)])),
        "residuals": ([*AXES, *(f"{axis}_sd" for axis in AXES)], np.column_stack([trace.residual, trace.residual_sd])),
        "motors": (rotors, trace.command),
    }
    for topic, flown, wanted in (("attitude", trace.attitude, trace.wanted), ("rates", trace.rates, trace.rates_wanted)):
        there = {prefix: values for prefix, values in (("", flown), ("wanted_", wanted)) if values is not None}
        if there:
            names = [f"{prefix}{axis}" for prefix in there for axis in ANGLES]
            found[topic] = names, np.column_stack([*there.values()])
    bands = np.stack([trace.loss, trace.lower, trace.upper], axis=2)
    found["losses"] = [f"{rotor}.{field}" for rotor in rotors for field in BAND], bands.reshape(len(bands), -1)
    return {f"/{NAME}/{topic}": series for topic, series in found.items()}


def _ticks(trace: Trace) -> Iterator[Row]:
    for topic, (names, values) in _series(trace).items():
        outer = [name.rpartition(".")[0] for name in names]
        groups = [[*of] for _, of in groupby(range(len(names)), outer.__getitem__)]
        for time, row in zip(trace.time.tolist(), values.tolist()):
            parts = (_fields(names, row, of) for of in groups)
            if text := ",".join(part for part in parts if part):
                yield time, topic, f'{{"time_s":{time:.6f},{text}}}'


def _fields(names: list[str], row: list[float], of: list[int]) -> str:
    """Finite numbers as the inside of a JSON object, nested where their names have a dot."""
    outer, dot, _ = names[of[0]].partition(".")
    text = ",".join(f'"{names[k].rpartition(".")[2]}":{row[k]:.6g}' for k in of if abs(row[k]) < np.inf)
    return f'"{outer}":{{{text}}}' if dot and text else text


def _phases(trace: Trace) -> Iterator[Row]:
    """A message at each change of phase: on the ground, assessed, or why blind."""
    phase = np.full(trace.time.size, ON_GROUND, object)
    for start, end in trace.airborne:
        phase[(trace.time >= start) & (trace.time <= end)] = ASSESSED
    for start, end, why in trace.blind:
        phase[(trace.time >= start) & (trace.time < end) & (phase != ON_GROUND)] = why
    changed = np.flatnonzero(np.r_[True, phase[1:] != phase[:-1]])
    yield from (_message("state", float(trace.time[k]), {"phase": phase[k]}) for k in changed)


def _schema(topic: str, text: str, names: list[str] | None) -> dict[str, Any]:
    """The JSON schema of a topic, from the names of its numbers, else from one of its messages. Nothing is required: unknown
    values are left out."""
    if topic == LOG:
        parts = {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}
        moment = {"type": "object", "title": "time", "properties": parts}
        words = {name: {"type": "string"} for name in ("message", "name", "file")}
        numbers = {name: {"type": "integer"} for name in ("level", "line")}
        return {"title": "foxglove.Log", "type": "object", "properties": {"timestamp": moment, **words, **numbers}}
    about: dict[str, Any] = json.loads(text)
    if names is not None:
        about = {"time_s": 0.0}
        for name in names:
            outer, dot, inner = name.partition(".")
            about.setdefault(outer, {} if dot else 0.0)
            if dot:
                about[outer][inner] = 0.0
    return {"title": f"{NAME}.{topic.rpartition('/')[2].capitalize()}", **_kind(about)}


def _kind(value: Any) -> dict[str, Any]:
    if isinstance(value, dict):
        return {"type": "object", "properties": {name: _kind(inner) for name, inner in value.items()}}
    if isinstance(value, list):
        return {"type": "array", "items": _kind(value[0]) if value else {}}
    if value is None:
        return {}
    return {"type": "string" if isinstance(value, str) else "boolean" if isinstance(value, bool) else "number"}
