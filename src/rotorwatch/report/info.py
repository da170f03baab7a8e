"""Contents of a log, gaps for a diagnosis, and the autopilot's settings that close them.

The diagnosis' own functions decide whether the log can be judged.
"""

from __future__ import annotations

import functools
import operator
import re
from collections.abc import Callable, Sequence
from typing import NamedTuple

from rotorwatch import airframes
from rotorwatch.answer import unjudged
from rotorwatch.answer.wording import sentence
from rotorwatch.base.progress import portion
from rotorwatch.engine.driver import observe
from rotorwatch.engine.motion import mixing, trust, turning
from rotorwatch.engine.motion.air_spans import airborne
from rotorwatch.engine.motion.missed import without_missed
from rotorwatch.engine.motion.tick_table import READY_S, tick_length
from rotorwatch.errors import RotorwatchError
from rotorwatch.flight import Flight, Signal
from rotorwatch.flight.diagnosis import SCHEMA
from rotorwatch.flight.vehicle import Vehicle
from rotorwatch.witnesses.balance import hearing

# Faster logging than this finds nothing sooner; of vehicles that never hover no short moment.
FAST_HZ, FAST_BLACKBOX_HZ = 50.0, 500.0
MESSAGES_SHOWN = 40

# Settings that log a signal; {10} in one is a bit (`_with_values`). ArduPilot: LOG_BITMASK bits of ArduCopter/defines.h
# (MASK_LOG_*); PX4: SDLOG_PROFILE bits of src/modules/logger (logged_topics.cpp). Anything else: the column to add.
_ARDUPILOT = {
    "motors": "Set LOG_BITMASK{10} (motor outputs, RCOU).",
    "control": "Set LOG_BITMASK{0} (attitude and RATE at loop rate; bit 1: at 10 Hz).",
    "gyro": "Set LOG_BITMASK{18} (IMU at loop rate; bit 7: at 25 Hz).",
    "accel": "Set LOG_BITMASK{18} (IMU at loop rate; bit 7: at 25 Hz).",
    "attitude": "Set LOG_BITMASK{0} (attitude at loop rate; bit 1: at 10 Hz).",
    "battery": "Set LOG_BITMASK{9} (battery) and a battery monitor (BATT_MONITOR).",
    "lift": "Set LOG_BITMASK{17} (motor battery compensation, MOTB).",
}
_PX4 = {
    "motors": "Set SDLOG_PROFILE{0} (default set): actuator_motors and actuator_outputs at 10 Hz.",
    "control": "Set SDLOG_PROFILE{0} (default set): vehicle_torque_setpoint and vehicle_thrust_setpoint.",
    "gyro": "Set SDLOG_PROFILE{0} (default set): vehicle_angular_velocity or sensor_combined.",
    "accel": "Set SDLOG_PROFILE{0} (default set): vehicle_acceleration or sensor_combined.",
    "attitude": "Set SDLOG_PROFILE{0} (default set): vehicle_attitude.",
    "battery": "Set SDLOG_PROFILE{0} (default set): battery_status.",
}
_CRAZYFLIE = {"gyro": "Add gyro.x, gyro.y and gyro.z to config.txt on the memory card."}
_BLACKBOX = {
    "gyro": "Log it: set blackbox_disable_gyro = OFF (fields_disabled_mask).",
    "accel": "Switch the accelerometer on (acc_hardware = AUTO) and log it (blackbox_disable_acc = OFF).",
    "attitude": "Betaflight from 2025.12 on and INAV log it where an accelerometer is on (blackbox_disable_attitude = OFF).",
    "battery": "Set vbat as the battery's voltage meter and log it (blackbox_disable_bat = OFF).",
    "control": "Betaflight from 4.0 on logs it, with setpoint[3]: set blackbox_disable_pids and blackbox_disable_setpoint = OFF.",
    "esc": "Betaflight from 4.5 on logs it (eRPM) with bidirectional DShot: set dshot_bidir = ON and motor_poles. INAV: ESC telemetry.",
}
_TELEMETRY = "Telemetry may not carry it; use the log that the autopilot wrote itself (.bin or .ulg)."
_BAG = "Record its topic, and have the autopilot send it (docs/foxglove.md), or use the log that the autopilot wrote itself."
_FASTER = {
    "ardupilot": {
        "motors": "Set LOG_BITMASK{0} (RATE at loop rate): the commands are rebuilt from it.",
        "gyro": "Set LOG_BITMASK{18} (IMU at loop rate).",
    },
    "px4": {
        "motors": "Set SDLOG_PROFILE{4} (high rate): actuator_motors at full rate.",
        "gyro": "Set SDLOG_PROFILE{4} (high rate): vehicle_angular_velocity at full rate.",
    },
    "blackbox": {"gyro": "Set blackbox_sample_rate to 1/4 or more; before Betaflight 4.3: blackbox_p_ratio, blackbox_rate_denom."},
}
_WHY = {
    "motors": "No motor commands: without them no rotor can be assessed.",
    "gyro": "No angular rates: they can only be derived from the attitude, where that is logged.",
    "accel": "No accelerations: thrust cannot be checked, so a loss common to all rotors goes undetected.",
    "control": "No rate controller output: an overridden output cannot be distinguished from a commanded one.",
    "attitude": "No attitude: take-off, landing and flips are found less reliably.",
    "battery": "No battery voltage: battery sag cannot be distinguished from a loss common to all rotors.",
    "lift": "No battery compensation of the autopilot: it is estimated from the voltage.",
    "esc": "No motor speeds: a short desync is less certain, and a slow motor cannot be distinguished from a damaged propeller.",
}
_ONLY = {"lift": "ardupilot", "esc": "blackbox"}
"""Signals that only logs of one autopilot can lack."""


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
    end_s}]; messages, the notable ones: [{time_s, kind, text}]; ready: whether `diagnose` judges it; hears: whether it shows the rotors'
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
    """The first reason for which `diagnose` refuses this flight, or answers that nothing in it can be judged; None when it judges it.

    vehicle: the airframe, for logs that do not name theirs. progress: called with the finished share, 0..1.
    """
    try:
        craft = vehicle or airframes.identify(flight)
        airframes.check(craft, flight)
    except RotorwatchError as why:
        return Obstacle("frame", str(why))
    if not flight.has("motors"):
        return Obstacle("motors", "The log has no motor outputs: without them no rotor can be assessed.")
    flight, _ = turning.with_rates(flight)
    if flight.angular_rate() is None:
        return Obstacle("gyro", sentence(f"{unjudged.MOTIONLESS.why}."))
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
    """Gaps, the one that prevents a diagnosis first. A signal counts as there with two valid samples."""
    telemetry = {"MAVLink tlog": _TELEMETRY, "ROS 2 bag": _BAG}.get(flight.format)
    settings = {"ardupilot": _ARDUPILOT, "px4": _PX4, "crazyflie": _CRAZYFLIE, "blackbox": _BLACKBOX}.get(_family(flight), {})
    gaps = []
    for name, why in _WHY.items():
        if _present(flight, name) or (name == "gyro" and _present(flight, "rates")):
            continue
        if _ONLY.get(name, _family(flight)) != _family(flight):
            continue
        setting = telemetry or settings.get(name, f"Log it, or give a table with the signal '{name}'.")
        gaps.append(_gap(name, why, setting, name == "motors" or (stop is not None and stop.what == name)))
    faster = {} if telemetry else _FASTER.get(_family(flight), {})
    for name, setting in faster.items():
        # ArduPilot's motor commands are rebuilt from the rate controller's output where that is logged faster.
        rates = [flight[n].rate_hz for n in ((name, "control") if name == "motors" else (name,)) if _present(flight, n)]
        if not _present(flight, name):
            continue
        if _family(flight) == "blackbox" and max(rates) < 0.99 * FAST_BLACKBOX_HZ:
            gaps.append(_gap(name, f"Gyro at {max(rates):.3g} Hz: short events such as desyncs can be missed.", setting, False, True))
        elif max(rates) < FAST_HZ:
            often = f"assessed every {tick_length(max(rates)):g} s; faster logging detects a loss sooner"
            gaps.append(_gap(name, f"{name.capitalize()} at {max(rates):.3g} Hz: {often}.", setting, False, True))
    if stop and stop.what in _OBSTACLES:
        name, setting = _OBSTACLES[stop.what]
        # Of an unknown frame the whole sentence is among the warnings.
        unknown = stop.what == "frame" and not frame
        why = "The airframe is not known from this log." if unknown else stop.why
        gaps.append(_gap(name, why[:1].upper() + why[1:], setting, True))
    return sorted(_with_values(flight, gaps), key=lambda gap: not gap["needed"])


def _with_values(flight: Flight, gaps: Sequence[dict]) -> list[dict]:
    """Gaps with the whole new value of a parameter in place of a {bit}: the logged value with the bits of all gaps, so that following one
    does not undo another. Without the parameter in the log: the value that the bit adds."""

    def filled(setting: str) -> str:
        name = next((one for one in ("LOG_BITMASK", "SDLOG_PROFILE") if f"{one}{{" in setting), "")
        if not name:
            return setting
        bits = [int(bit) for gap in gaps for bit in re.findall(rf"{name}{{(\d+)}}", gap["setting"])]
        now = flight.parameters.get(name, -1.0)
        if not (0.0 <= now < 2.0**31 and now == int(now)):
            return re.sub(r"{(\d+)}", lambda bit: f" bit {bit[1]}, which adds {1 << int(bit[1])} to its value", setting)
        whole = functools.reduce(operator.or_, (1 << bit for bit in bits), int(now))
        return re.sub(r"{(\d+)}", rf" to {whole} (it is {int(now)}): bit \1", setting)

    return [gap | {"setting": filled(gap["setting"])} for gap in gaps]


def _gap(signal: str, why: str, setting: str, needed: bool, present: bool = False) -> dict:
    return {"signal": signal, "why": why, "setting": setting, "needed": needed, "present": present}


def _present(flight: Flight, name: str) -> bool:
    valid = flight[name].valid if flight.has(name) else None
    return valid is not None and (bool(flight[name].whole[:2].all()) or int(valid.any(axis=1).sum()) >= 2)


def _family(flight: Flight) -> str:
    autopilot = flight.autopilot.lower()
    if flight.format.startswith("Blackbox"):
        return "blackbox"
    return next((name for name in ("ardupilot", "px4", "crazyflie") if name in autopilot), "")


def _messages(flight: Flight) -> list[dict]:
    """Notable messages: errors, modes, arming, landing, dropouts, texts on motors and failsafes."""
    words = "thrust motor esc crash failsafe fail-safe vibration battery error emergency lost".split()
    shown = [m for m in flight.messages if m.kind != "text" or any(w in m.text.lower() for w in words)]
    return [{"time_s": round(float(m.time), 3), "kind": m.kind, "text": m.text} for m in shown[:MESSAGES_SHOWN]]
