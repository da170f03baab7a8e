"""What the autopilot itself wrote while it flew: failsafes, and what its own checks found; and a log that ends in the air.

Each trouble is one claim, at its first report. It accuses no rotor and clears none: it is told beside what rotors did, in the order of
time. The texts and numbers are those of ArduPilot (subsystems and codes of ERR, texts of MSG), PX4 (its log messages) and Betaflight
(phases of its failsafe).
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from rotorwatch.engine.motion.allocation import Spans
from rotorwatch.flight import Flight, Message
from rotorwatch.flight.diagnosis import Event
from rotorwatch.flight.kinds import REPORTED

LATE_S = 1.0  # after a flight: what ended it is written down a moment later
LOW_S = 3.0  # for which a voltage is low before it is told
WRITES = ("error", "text", "event")


class Trouble(NamedTuple):
    """name: in `extra.trouble`. words: a clause that follows "the autopilot". says: its reports."""

    name: str
    words: str
    says: re.Pattern[str]


def _of(name: str, words: str, *says: str) -> Trouble:
    return Trouble(name, words, re.compile("|".join(says), re.IGNORECASE))


# A report is of the first that it matches.
TROUBLES = (
    _of("crash", "took the vehicle for crashed", r"^crash check: error", r"^crash: disarming"),
    _of(
        "battery", "found the battery low", r"^battery failsafe: error", r"\b(low|critical|dangerous|emergency) battery",
        r"\bbattery\b(?!.*resolved).*\b(low|critical|dangerous|emergency|failsafe)\b",
    ),
    _of(
        "radio", "lost the radio", r"^radio( failsafe)?: error", r"\b(rc|manual control)( signal)? lost",
        r"^failsafe: .*(rx|signal|radio)",
    ),
    _of("vibration", "found too much vibration", r"^vibration: error", r"^vibration compensation on", r"\bhigh vibration"),
    _of(
        "position", "lost its position", r"^gps: error", r"\bgps glitch(?! cleared)", r"\b(global|local) position (lost|invalid)",
        r"\bnavigation failure",
    ),
    _of(
        "estimator", "doubted its own estimate", r"^estimator (check|failsafe): error", r"\bekf\d? (variance|lane switch|primary changed)",
        r"\bekf failsafe(?!.*cleared)", r"\bemergency yaw reset",
    ),
    _of("compass", "found the compass wrong", r"^compass: error", r"\bcompass(es)? (error|failure|inconsistent)"),
    _of("imu", "found an IMU wrong", r"^imu failure", r"\b(accel|gyro)\w*\b.*\b(failure|inconsistent|timeout)"),
)  # fmt: skip


def claims(flight: Flight, air: Spans) -> tuple[Event, ...]:
    """The reports in the flights `air` ((start, end), ...) s."""
    told = _reports(flight.messages, air)
    if not any(e.extra["trouble"] == "battery" for e in told):
        told += _low_voltage(flight, air)
    return tuple(sorted(told, key=lambda e: e.onset_s))


def _reports(messages: tuple[Message, ...], air: Spans) -> list[Event]:
    found: dict[str, list[Message]] = {}
    words = {t.name: t.words for t in TROUBLES}
    for m in messages:
        if m.kind in WRITES and any(start <= m.time <= end + LATE_S for start, end in air):
            trouble = next((t.name for t in TROUBLES if t.says.search(m.text)), None)
            if trouble is not None:
                found.setdefault(trouble, []).append(m)
    made = []
    for name, all_ in found.items():
        first = all_[0]
        again = f", and {len(all_) - 1} more" if len(all_) > 1 else ""
        reason = f'the autopilot {words[name]} ("{first.text}"{again})'
        made.append(
            _event(first.time, reason, {"trouble": name, "texts": list(dict.fromkeys(m.text for m in all_))[:5]})
        )
    return made


def _low_voltage(flight: Flight, air: Spans) -> list[Event]:
    """The battery's voltage was below the autopilot's own limit in flight, for LOW_S."""
    set_, battery = flight.parameters, flight.signals.get("battery")
    limits = {"BATT_LOW_VOLT": 1.0, "BATT_CRT_VOLT": 1.0, "BAT1_V_EMPTY": set_.get("BAT1_N_CELLS", 0.0)}
    name, limit = next(((k, set_[k] * n) for k, n in limits.items() if set_.get(k, 0.0) * n > 0.0), ("", 0.0))
    if battery is None or not limit or not air:
        return []
    aloft = np.zeros(len(battery), bool)
    for start, end in air:
        aloft |= (battery.time >= start) & (battery.time <= end)
    inside = aloft & battery.valid[:, 0]
    time, volts = battery.time[inside], battery.values[inside, 0]
    low = (volts > 0.0) & (volts < limit)
    since = time[np.maximum.accumulate(np.where(low, 0, np.arange(time.size)))] if time.size else time
    lasted = np.flatnonzero(low & (time - since >= LOW_S))
    if not lasted.size:
        return []
    least = float(volts[low].min())
    reason = f"the battery had {least:.1f} V under load, less than {name} allows ({limit:.1f} V)"
    extra = {"trouble": "battery", "least_v": round(least, 2), "limit_v": round(limit, 2)}
    return [_event(float(since[lasted[0]]), reason, extra)]


def _event(time: float, reason: str, extra: dict) -> Event:
    return Event(REPORTED, (), time, time, None, (), (), 1.0, (), reason, extra)


def end(flight: Flight, air: Spans) -> tuple[str, ...]:
    """A sentence where the log ends in the air: nothing comes after its last flight, neither a landing nor disarmed motors."""
    if not air or air[-1][1] < flight.duration - LATE_S:
        return ()
    last = air[-1][1]
    if any(m.kind in ("landed", "armed") and m.time > last - LATE_S for m in flight.messages):
        return ()
    why = "the power or the logging failed, or somebody stopped it"
    return (f"The log ends in the air at {last:.1f} s: {why}. What happened then is not in it.",)
