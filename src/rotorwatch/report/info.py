"""Contents of a log, gaps for a diagnosis, and the autopilot's settings that close them.

The diagnosis' own functions decide whether the log can be assessed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from rotorwatch import airframes
from rotorwatch.answer import settings, unassessed
from rotorwatch.answer.wording import sentence
from rotorwatch.base.progress import portion
from rotorwatch.engine.driver import observe
from rotorwatch.engine.motion import mixing, trust, turning
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.missed import without_missed
from rotorwatch.engine.motion.tick_table import READY_S
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.diagnosis import SCHEMA
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.balance import hearing

MESSAGES_SHOWN = 40


# Gaps other than signals, and the remedy.
_OBSTACLES = {
    "frame": ("frame", "Give its geometry with --vehicle FILE."),
    "airborne": ("airborne", "Use a log of a flight, not of a bench test."),
    "trust": ("log", "Use another log of this flight, or another flight."),
}


def info(flight: Flight, progress: Callable[[float], object] | None = None) -> dict:
    """Contents and gaps of a log, as `rotorwatch info --json` prints them. Times in s from the first record of the log.

    flight: as `rotorwatch.read` gives it. progress: called with the finished share, 0..1.

    Returns schema, name, format, autopilot, firmware, vehicle_type, frame, rotors, duration_s; parameters: how many;
    airborne_s: [[start, end]]; signals: [{name, rate_hz, samples, columns, unit, frame, source, valid (share), start_s,
    end_s}]; messages, the notable ones: [{time_s, kind, text}]; ready: whether `diagnose` assesses it; hears: whether it shows the rotors'
    balance: {ready, why, setting, sensor};
    missing: [{signal, why, setting, needed, present: it is there, and would show more faster}]; warnings. docs/json.md has more on each.
    """
    frame, warnings = _frame(flight)
    hops = _airborne(flight)
    if progress:
        progress(0.1)
    stop = obstacle(flight, progress=portion(progress, 0.1, 0.9))
    missing = _missing(flight, frame, stop)
    return {
        "schema": SCHEMA,
        "name": flight.name,
        "format": flight.format,
        "autopilot": flight.autopilot,
        "firmware": flight.firmware,
        "vehicle_type": flight.vehicle_type,
        "frame": frame,
        "rotors": flight.rotor_count,
        "duration_s": round(float(flight.duration), 3),
        "airborne_s": hops,
        "signals": [_signal(name, s) for name, s in sorted(flight.signals.items())],
        "parameters": len(flight.parameters),
        "messages": _messages(flight),
        "ready": stop is None,
        "hears": _hears(flight),
        "missing": missing,
        "warnings": [*flight.warnings, *warnings],
    }


class Obstacle(NamedTuple):
    """Obstacle to a diagnosis. what: frame, motors, gyro, airborne or trust. why: one sentence."""

    what: str
    why: str


def obstacle(flight: Flight, vehicle: Vehicle | None = None, progress: Callable[[float], object] | None = None) -> Obstacle | None:
    """The first reason for which `diagnose` refuses this flight, or answers that nothing in it can be assessed; None when it assesses it.

    vehicle: the airframe, for logs that do not name theirs. progress: called with the finished share, 0..1.
    """
    try:
        craft = airframes.of(flight, vehicle)
    except RotorwatchError as why:
        return Obstacle("frame", str(why))
    if not flight.has("motors"):
        return Obstacle("motors", "The log has no motor outputs: without them no rotor can be assessed.")
    flight, _ = turning.with_rates(flight)
    if flight.angular_rate() is None:
        return Obstacle("gyro", sentence(f"{unassessed.MOTIONLESS.why}."))
    air = airborne(flight)
    if progress:
        progress(0.1)
    flight = mixing.aligned(without_missed(flight, air), craft, air)
    table = observe(flight, craft, air, READY_S, portion(progress, 0.1, 0.6))
    if table is None:
        return Obstacle("airborne", "No part of this log is in the air.")
    doubts = trust.contradictions(flight, craft, air, table, portion(progress, 0.6, 1.0))
    return Obstacle("trust", doubts[0]) if doubts else None


def _signal(name: str, signal: Signal) -> dict:
    some = len(signal) > 0
    return {
        "name": name,
        "rate_hz": round(signal.rate_hz, 2),
        "samples": len(signal),
        "columns": list(signal.columns),
        "unit": signal.unit,
        "frame": signal.frame,
        "source": signal.source,
        "valid": round(float(signal.valid.mean()), 4) if some and signal.valid is not None else 0.0,
        "start_s": round(float(signal.time[0]), 3) if some else None,
        "end_s": round(float(signal.time[-1]), 3) if some else None,
    }


def _hears(flight: Flight) -> dict:
    """Whether the rotors' balance can be heard, and if not, which setting would log what is missing."""
    deaf = hearing.deaf(flight, flight.rotor_count)
    sensor = hearing.sensor(flight, flight.rotor_count) if deaf is None else None
    if deaf is None and sensor is not None:
        return {"ready": True, "why": "", "setting": "", "sensor": sensor.signal.source}
    why, setting = deaf or ("", "")
    return {"ready": False, "why": why, "setting": setting, "sensor": ""}


def _frame(flight: Flight) -> tuple[str, list[str]]:
    """The airframe's name, empty when it is not known; and why not."""
    try:
        return airframes.identify(flight).name, []
    except RotorwatchError as why:
        return "", [str(why)]


def _airborne(flight: Flight) -> list[list[float]]:
    try:
        return [[round(float(a), 3), round(float(b), 3)] for a, b in airborne(flight)]
    except RotorwatchError:
        return []


def _missing(flight: Flight, frame: str, stop: Obstacle | None) -> list[dict]:
    """Gaps, the one that prevents a diagnosis first."""
    gaps = settings.lacking(flight, stop.what if stop else "")
    if stop and stop.what in _OBSTACLES:
        name, setting = _OBSTACLES[stop.what]
        # Of an unknown frame the whole sentence is among the warnings.
        unknown = stop.what == "frame" and not frame
        why = "The airframe is not known from this log." if unknown else stop.why
        gaps.append(settings.gap(name, why[:1].upper() + why[1:], setting, True))
    return sorted(gaps, key=lambda gap: not gap["needed"])


def _messages(flight: Flight) -> list[dict]:
    """Notable messages: errors, modes, arming, landing, dropouts, texts on motors and failsafes."""
    words = "thrust motor esc crash failsafe fail-safe vibration battery error emergency lost".split()
    shown = [m for m in flight.messages if m.kind != "text" or any(w in m.text.lower() for w in words)]
    return [{"time_s": round(float(m.time), 3), "kind": m.kind, "text": m.text} for m in shown[:MESSAGES_SHOWN]]
